// The volume in 3D, with the grey values of the slices. Without WebGL2 its section stays hidden.
(() => {
  const data = dataOf("volume-data");
  if (!data) return;
  const find = (id) => document.getElementById(id);
  const section = find("volume"), canvas = find("space"), reading = find("space-reading"), bar = find("space-bar");
  const threshold = find("threshold"), turn = find("turn"), tilt = find("tilt"), zoom = find("space-zoom");
  const centres = find("centres"); // null for a volume without Gaussians
  const links = document.querySelectorAll('a[href="#volume"]');
  const letters = ["x", "y", "z"].map((axis) => find("space-" + axis));
  const camera = new Camera(turn.valueAsNumber, tilt.valueAsNumber, Number(zoom.max));
  const TURNING_MS = 40, REST_AFTER_MS = 160, LEAST_SHARE = 0.15;
  let renderer = null, ends = data.ends, asked = 0, resting = 0, isVisible = false;
  let share = 0.35; // fraction of the screen's pixels along each side, while something moves

  const showsSurface = () => find("space-surface").checked;
  const show = (isShown) => [section, ...links].forEach((part) => (part.hidden = !isShown));

  // Centres as (x, y, z, weight) in mm about the middle of the box.
  function points() {
    if (!data.centres) return null;
    const places = new Uint16Array(bytesOf(data.centres.places).buffer), weights = bytesOf(data.centres.densities);
    const values = new Float32Array(4 * weights.length);
    weights.forEach((weight, k) => {
      for (let axis = 0; axis < 3; axis++) {
        values[4 * k + axis] = (places[3 * k + axis] / 65535 - 0.5) * data.size_mm[axis];
      }
      values[4 * k + 3] = 0.08 + (0.92 * weight) / 255;
    });
    return values;
  }

  // Returns how many milliseconds the picture took, or null where nothing is drawn.
  function draw(ofPixels) {
    if (!renderer || !isVisible) return null;
    const level = showsSurface() ? threshold.valueAsNumber : null;
    const took_ms = renderer.draw({ camera, ends, threshold: level, points: centres && centres.checked, share: ofPixels });
    setBar(bar, 2 * renderer.extent_mm(camera.zoom)[0]);
    label();
    return took_ms;
  }

  function drawMoving() {
    asked = 0;
    const took_ms = draw(share), times = took_ms > 1.3 * TURNING_MS ? 0.8 : took_ms < 0.6 * TURNING_MS ? 1.25 : 1;
    if (took_ms === null) return;
    share = clamp(share * times, LEAST_SHARE, 1);
    resting = setTimeout(refine, REST_AFTER_MS, Math.min(1, 2 * share));
  }

  // Draws the picture at rest finer and finer, as long as the next one takes fewer milliseconds than ``data-patience``.
  function refine(ofPixels) {
    const took_ms = draw(ofPixels);
    if (took_ms !== null && ofPixels < 1 && 4 * took_ms < Number(canvas.dataset.patience)) resting = setTimeout(refine, 0, Math.min(1, 2 * ofPixels));
  }

  // The letters of the axes, at the ends of the three edges that are the strongest.
  function label() {
    const { right, up } = camera.axes(), [across, high] = renderer.extent_mm(camera.zoom);
    letters.forEach((letter, axis) => {
      const at = data.size_mm.map((size, k) => (k === axis ? 0.55 : -0.5) * size);
      const place = [dot(at, right) / across, dot(at, up) / high].map((share) => clamp(share, -0.95, 0.95));
      letter.style.left = 50 + 50 * place[0] + "%";
      letter.style.top = 50 - 50 * place[1] + "%";
    });
  }

  // While something moves, the picture has fewer pixels, so that it keeps up with the hand.
  function redraw() {
    asked = asked || requestAnimationFrame(drawMoving);
    clearTimeout(resting);
  }

  function say(slider, value, words) {
    slider.value = value;
    find(slider.id + "-value").textContent = words;
    slider.setAttribute("aria-valuetext", words);
  }

  function showView() {
    say(turn, camera.turn, Math.round(camera.turn) + "°");
    say(tilt, camera.tilt, inWords(camera.tilt, 0) + "°");
    say(zoom, camera.zoom, Number(camera.zoom.toFixed(1)) + "×");
    redraw();
  }

  function showKind() {
    threshold.disabled = !showsSurface();
    const value = data.least + (threshold.valueAsNumber / 255) * (data.most - data.least);
    say(threshold, threshold.value, inWords(value, data.decimals) + " 1/mm");
    const kind = showsSurface() ? `Surface at ${threshold.getAttribute("aria-valuetext")}` : "Maximum along each ray";
    reading.textContent = `${kind}, of ${data.words}.`;
    redraw();
  }

  function reset() {
    camera.reset();
    threshold.value = threshold.defaultValue;
    showView();
    showKind();
  }

  for (const slider of [turn, tilt, zoom]) {
    slider.addEventListener("input", () => {
      Object.assign(camera, { turn: turn.valueAsNumber, tilt: tilt.valueAsNumber, zoom: zoom.valueAsNumber });
      showView();
    });
  }
  for (const choice of document.querySelectorAll('input[name="space-kind"]')) choice.addEventListener("change", showKind);
  threshold.addEventListener("input", showKind);
  if (centres) centres.addEventListener("change", redraw);
  find("space-reset").addEventListener("click", reset);
  document.addEventListener("grey-window", (event) => {
    ends = event.detail;
    redraw();
  });
  makeTurnable(canvas, camera, showView);
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    renderer = null;
  });
  canvas.addEventListener("webglcontextrestored", start);

  async function start() {
    try {
      renderer = new VolumeRenderer(canvas, { counts: data.counts, bytes: await voxelsOf(data), size_mm: data.size_mm, points: points() });
    } catch {
      return; // the slices show the volume too
    }
    show(true);
    showView();
    showKind();
    canvas.dataset.drawn = "true";
  }
  // The device draws only what is seen; a wider picture needs more pixels.
  new IntersectionObserver(([entry]) => ((isVisible = entry.isIntersecting), redraw())).observe(canvas);
  new ResizeObserver(redraw).observe(canvas.parentElement);
  start();
})();
