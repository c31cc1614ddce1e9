// Slices, grey values, zoom and readings of the three planes. Without this script the page shows the middle slices.
(() => {
  const data = dataOf("slice-data");
  if (!data) return;
  const { planes, windows, colours } = data;
  const palette = colours && bytesOf(colours);
  const black = document.getElementById("black"), white = document.getElementById("white");
  const zoom = document.getElementById("zoom"), reading = document.getElementById("reading");
  const ends = {}; // by layer: the grey levels, of 256, of black and white
  const parts = {}; // by the axis across the plane: its elements and state
  const origin = {}; // by axis: the fraction at which the picture stays fixed under zoom
  let layer = "result", pointed = null, armed = null;

  const isGrey = () => layer !== "difference";
  const kind = () => (layer === "truth" ? "result" : layer); // the truth has the result's window
  const valueOf = (step) => windows[layer].least + (step / 255) * (windows[layer].most - windows[layer].least);

  function inPerMm(step) {
    const { beyond, decimals } = windows[layer];
    const sign = step <= 0 && beyond[0] ? "≤ " : step >= 255 && beyond[1] ? "≥ " : "";
    return sign + inWords(valueOf(step), decimals) + " 1/mm";
  }

  function initialEnds(name) {
    const { low, high, least, most } = windows[name];
    return [low, high].map((value) => (255 * (value - least)) / (most - least || 1));
  }

  // Where the middle of a plane's present slice lies, as a fraction of the axis.
  function share(axis) {
    const { plane, slider } = parts[axis];
    return (plane.indices[Number(slider.value)] + 0.5) / plane.count;
  }

  function draw() {
    for (const part of Object.values(parts)) {
      const { plane, slider, image, place } = part;
      const k = Number(slider.value), source = "data:image/png;base64," + plane.layers[layer][k];
      place.textContent = plane.places[k];
      slider.setAttribute("aria-valuetext", plane.places[k]);
      if (part.source === source) continue;
      part.source = image.src = source;
      part.steps = null;
      image.decode().then(
        () => part.source === source && (take(part), paint(part), read()),
        () => {}, // another slice was chosen meanwhile
      );
    }
    magnify();
    read();
  }

  // The grey levels of a decoded slice.
  function take(part) {
    const { image, canvas } = part;
    canvas.width = image.naturalWidth;
    canvas.height = image.naturalHeight;
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0);
    part.pixels = context.getImageData(0, 0, canvas.width, canvas.height);
    part.steps = part.pixels.data.filter((_, i) => i % 4 === 0);
  }

  function paint(part) {
    if (!part.steps) return;
    const [first, last] = ends[kind()], { data } = part.pixels;
    const colour = Array.from({ length: 256 }, (_, step) => {
      const shown = Math.round(255 * clamp((step - first) / (last - first || 1), 0, 1));
      return isGrey() ? [shown, shown, shown] : palette.subarray(3 * shown, 3 * shown + 3);
    });
    part.steps.forEach((step, i) => {
      [data[4 * i], data[4 * i + 1], data[4 * i + 2]] = colour[step];
    });
    part.canvas.getContext("2d").putImageData(part.pixels, 0, 0);
  }

  function showWindow() {
    const [first, last] = ends[kind()];
    black.disabled = !isGrey(); // differences have symmetric ends
    for (const [slider, step, name] of [[black, first, isGrey() ? "Black" : "Blue"], [white, last, isGrey() ? "White" : "Red"]]) {
      slider.previousElementSibling.textContent = name;
      slider.value = step;
      document.getElementById(slider.id + "-value").textContent = inPerMm(step);
      slider.setAttribute("aria-valuetext", inPerMm(step));
    }
    Object.values(parts).forEach(paint);
    document.dispatchEvent(new CustomEvent("grey-window", { detail: ends.result }));
  }

  function moveWindow(slider) {
    const [first, last] = ends[kind()], step = Number(slider.value);
    if (!isGrey()) ends.difference = [255 - Math.max(step, 128), Math.max(step, 128)];
    else ends[kind()] = slider === black ? [Math.min(step, last - 1), last] : [first, Math.max(step, first + 1)];
    showWindow();
  }

  function magnify() {
    const times = Number(zoom.value);
    document.getElementById("zoom-value").textContent = times + "×";
    zoom.setAttribute("aria-valuetext", times + "×");
    for (const axis of Object.keys(parts)) {
      const at = origin[axis], here = share(axis); // a point out of sight becomes the middle of the zoomed picture
      if (times === 1 || here < at - at / times || here > at + (1 - at) / times) origin[axis] = here;
    }
    const seen = (axis) => 100 * (origin[axis] + times * (share(axis) - origin[axis]));
    for (const { plane, sheet, bar, across, upwards } of Object.values(parts)) {
      upwards.style.left = seen(plane.right) + "%";
      across.style.top = 100 - seen(plane.up) + "%";
      sheet.style.transform = `scale(${times})`;
      sheet.style.transformOrigin = `${100 * origin[plane.right]}% ${100 - 100 * origin[plane.up]}%`;
      setBar(bar, plane.width_mm / times);
    }
  }

  // Shows value and position under the pointer or, without a pointer, where the lines cross.
  function read() {
    const part = pointed ? pointed.part : parts.z, { plane, canvas, steps } = part;
    const [right, up] = pointed ? [pointed.right, pointed.up] : [share(plane.right), share(plane.up)];
    if (!steps) return;
    const column = Math.floor(right * canvas.width), row = Math.floor((1 - up) * canvas.height);
    const at = { [plane.right]: right, [plane.up]: up, [plane.axis]: share(plane.axis) };
    const places = ["x", "y", "z"].map((axis) => {
      const { first_mm, step_mm, count, decimals } = parts[axis].plane;
      return `${axis} ${inWords(first_mm + Math.floor(clamp(at[axis], 0, 0.999999) * count) * step_mm, decimals)}`;
    });
    const value = inPerMm(steps[clamp(row, 0, canvas.height - 1) * canvas.width + clamp(column, 0, canvas.width - 1)]);
    reading.textContent = `${pointed ? "Under the pointer" : "Where the lines cross"}, ${places.join(", ")} mm: ${value}`;
  }

  function goTo(axis, where) {
    const { plane, slider } = parts[axis];
    const wanted = clamp(where, 0, 0.999999) * plane.count - 0.5;
    const gap = (index) => Math.abs(index - wanted);
    slider.value = plane.indices.reduce((best, index, k) => (gap(index) < gap(plane.indices[best]) ? k : best), 0);
  }

  function point(event, part) {
    const box = part.sheet.getBoundingClientRect();
    const right = clamp((event.clientX - box.left) / box.width, 0, 1);
    pointed = { part, right, up: clamp(1 - (event.clientY - box.top) / box.height, 0, 1) };
  }

  function follow() {
    goTo(pointed.part.plane.right, pointed.right);
    goTo(pointed.part.plane.up, pointed.up);
    draw();
  }

  function turn(event, part) {
    if (armed !== part || !event.deltaY) return; // a page that is scrolled past a picture goes on
    const control = event.ctrlKey ? zoom : part.slider, before = control.value;
    const step = Number(control.step) * (event.deltaY > 0 ? -1 : 1);
    control.value = Number(before) + step;
    if (control.value === before && !event.ctrlKey) return; // at the end the page scrolls
    event.preventDefault();
    draw();
  }

  for (const [name, plane] of Object.entries(planes)) {
    const figure = document.getElementById("plane-" + name), find = (what) => figure.querySelector(what);
    const part = (parts[plane.axis] = {
      plane,
      slider: find("input"),
      image: find("img"),
      canvas: find("canvas"),
      sheet: find(".sheet"),
      bar: find(".bar"),
      place: find("output"),
      across: find(".across"),
      upwards: find(".upwards"),
    });
    origin[plane.axis] = 0.5;
    part.slider.addEventListener("input", draw);
    const box = find(".picture");
    box.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      if (event.pointerType === "mouse") box.setPointerCapture(event.pointerId);
      point(event, part);
      follow();
      if (event.pointerType !== "mouse") pointed = null; // a finger covers what it points at
    });
    box.addEventListener("pointermove", (event) => {
      if (event.pointerType !== "mouse") return;
      armed = part;
      point(event, part);
      if (event.buttons & 1) follow();
      else read();
    });
    box.addEventListener("pointerleave", () => {
      pointed = armed = null;
      read();
    });
    box.addEventListener("wheel", (event) => turn(event, part), { passive: false });
  }
  window.addEventListener("scroll", () => (armed = null), { passive: true });
  for (const slider of [black, white]) slider.addEventListener("input", () => moveWindow(slider));
  zoom.addEventListener("input", magnify);

  function reset() {
    for (const name of Object.keys(windows)) ends[name] = initialEnds(name);
    zoom.value = 1;
    showWindow();
    draw();
  }
  for (const button of document.querySelectorAll('input[name="layer"]')) {
    button.addEventListener("change", () => {
      layer = button.value;
      draw();
      showWindow();
    });
    if (button.checked) layer = button.value; // a browser that comes back remembers the choice
  }
  document.getElementById("reset").addEventListener("click", reset);
  document.documentElement.classList.add("scripted");
  reset();
})();
