// The object at point y and time t: v(y + w(y, t)), from the reference volume v and the displacement w, which arrows show.
(() => {
  const data = dataOf("motion-data"), volume = dataOf("volume-data");
  if (!data || !volume) return;
  const find = (id) => document.getElementById("motion-" + id);
  const time = find("time"), arrows = find("arrows"), reading = find("reading");
  const { counts } = volume, [nx, ny, nz] = counts, AXES = ["x", "y", "z"];
  const LASTS_MS = 8000, ARROW_EVERY_PX = 24, LEAST_PX = 2, BLACK = 20;
  const air = (-255 * volume.least) / (volume.most - volume.least || 1); // grey level of 0 1/mm, used outside the box
  const control = new Int16Array(bytesOf(data.control).buffer), perField = control.length / data.units_mm.length;
  let bytes = null, ends = volume.ends, asked = 0;

  const cubic = (x) => (Math.max(2 - Math.abs(x), 0) ** 3 - 4 * Math.max(1 - Math.abs(x), 0) ** 3) / 6;
  // By axis and voxel: the first of the four control points that reach it, and the weights of the four.
  const taps = counts.map((count, k) => Array.from({ length: count }, (_, i) => {
    const at = (data.first_mm[k] + i * data.step_mm[k] - data.origin_mm[k]) / data.spacing_mm[k], first = Math.floor(at) - 1;
    return { first, weights: [0, 1, 2, 3].map((j) => cubic(at - first - j)) };
  }));

  const timeNow = () => data.span_s[0] + (time.valueAsNumber / Number(time.max)) * (data.span_s[1] - data.span_s[0]);

  // The control points of the displacement at a time, in mm.
  function controlAt(time_s) {
    const { times_s, weights, units_mm } = data, after = times_s.findIndex((one) => one > time_s);
    const next = after < 0 ? times_s.length - 1 : after, last = Math.max(after < 0 ? next : after - 1, 0);
    const share = next > last ? (time_s - times_s[last]) / (times_s[next] - times_s[last]) : 0;
    const state = new Float32Array(perField);
    units_mm.forEach((unit_mm, field) => {
      const factor_mm = unit_mm * (weights[last][field] + share * (weights[next][field] - weights[last][field]));
      for (let i = 0; i < perField; i++) state[i] += factor_mm * control[field * perField + i];
    });
    return state;
  }

  // Vectors (z, y, x, 3) with control points along axis k replaced by the values at ``wanted`` voxels.
  function along(values, shape, k, wanted) {
    const stride = 3 * shape.slice(0, k).reduce((a, b) => a * b, 1), block = stride * shape[k];
    const result = new Float32Array((values.length / shape[k]) * wanted.length);
    for (let start = 0, at = 0; start < values.length; start += block) {
      for (const { first, weights } of wanted) {
        for (let j = Math.max(0, -first); j < 4 && first + j < shape[k]; j++) {
          const from = start + (first + j) * stride;
          for (let i = 0; i < stride; i++) result[at + i] += weights[j] * values[from + i];
        }
        at += stride;
      }
    }
    return result;
  }

  // Displacements (z, y, x, 3) in mm at the voxels of a slice.
  function displacements(state, axis, index) {
    const shape = [...data.shape];
    return [axis, ...[0, 1, 2].filter((k) => k !== axis)].reduce((values, k) => {
      const wanted = k === axis ? [taps[k][index]] : taps[k], result = along(values, shape, k, wanted);
      shape[k] = wanted.length;
      return result;
    }, state);
  }

  function voxel(x, y, z) {
    return x < 0 || y < 0 || z < 0 || x >= nx || y >= ny || z >= nz ? air : bytes[(z * ny + y) * nx + x];
  }

  function sample(x, y, z) {
    const i = Math.floor(x), j = Math.floor(y), k = Math.floor(z), a = x - i, b = y - j, c = z - k;
    const row = (v, w) => (1 - a) * voxel(i, v, w) + a * voxel(i + 1, v, w);
    return (1 - c) * ((1 - b) * row(j, k) + b * row(j + 1, k)) + c * ((1 - b) * row(j, k + 1) + b * row(j + 1, k + 1));
  }

  // Draws a slice of the object at a time; returns its longest displacement in mm.
  function draw({ axis, right, up, slider, canvas, overlay, output }, state) {
    const index = slider.valueAsNumber, field = displacements(state, axis, index), [first, last] = ends;
    const wide = counts[right], high = counts[up], at = [index, index, index];
    Object.assign(canvas, { width: wide, height: high });
    const context = canvas.getContext("2d"), image = context.createImageData(wide, high);
    const pixels = new Uint32Array(image.data.buffer), [faster, slower] = right < up ? [right, up] : [up, right];
    let longest_mm = 0;
    for (let q = 0; q < wide * high; q++) {
      at[faster] = q % counts[faster];
      at[slower] = Math.floor(q / counts[faster]);
      const x_mm = field[3 * q], y_mm = field[3 * q + 1], z_mm = field[3 * q + 2], [dx, dy, dz] = data.step_mm;
      const step = sample(at[0] + x_mm / dx, at[1] + y_mm / dy, at[2] + z_mm / dz);
      const grey = Math.round(255 * clamp((step - first) / (last - first || 1), 0, 1));
      pixels[(high - 1 - at[up]) * wide + at[right]] = 0xff000000 + 0x10101 * grey;
      longest_mm = Math.max(longest_mm, Math.hypot(x_mm, y_mm, z_mm));
    }
    context.putImageData(image, 0, 0);
    drawArrows(overlay, field, right, up, (r, u) => image.data[4 * ((high - 1 - u) * wide + r)] >= BLACK);
    const place = `${AXES[axis]} = ${inWords(data.first_mm[axis] + index * data.step_mm[axis], data.decimals)} mm`;
    output.textContent = `${place}, ${index + 1} of ${counts[axis]}`;
    slider.setAttribute("aria-valuetext", output.textContent);
    return longest_mm;
  }

  // Arrows end at voxels of the slice, and begin where their matter is in the reference volume. Black voxels have none.
  function drawArrows(overlay, field, right, up, isShown) {
    const density = Math.min(devicePixelRatio, 2), wide = overlay.clientWidth, high = overlay.clientHeight;
    const context = overlay.getContext("2d"), perVoxel = [wide / counts[right], high / counts[up]];
    Object.assign(overlay, { width: Math.round(wide * density), height: Math.round(high * density) });
    context.scale(density, density);
    const every = Math.max(1, Math.round(ARROW_EVERY_PX / perVoxel[0])), faster = Math.min(right, up);
    const path = new Path2D();
    for (let r = every >> 1; r < counts[right]; r += every) {
      for (let u = every >> 1; u < counts[up]; u += every) {
        const q = faster === right ? u * counts[right] + r : r * counts[up] + u;
        const x = (r + 0.5) * perVoxel[0], y = high - (u + 0.5) * perVoxel[1], times = arrows.valueAsNumber;
        const across = (times * perVoxel[0] * field[3 * q + right]) / data.step_mm[right];
        const down = (-times * perVoxel[1] * field[3 * q + up]) / data.step_mm[up], length = Math.hypot(across, down);
        if (length < LEAST_PX || !isShown(r, u)) continue;
        const [a, b] = [across / length, down / length].map((part) => part * Math.min(5, 0.6 * length));
        path.moveTo(x + across, y + down);
        path.lineTo(x, y);
        path.lineTo(x + a - 0.5 * b, y + b + 0.5 * a);
        path.moveTo(x, y);
        path.lineTo(x + a + 0.5 * b, y + b - 0.5 * a);
      }
    }
    for (const [colour, width] of [["#000", 3.5], ["#ffd24a", 1.5]]) {
      Object.assign(context, { strokeStyle: colour, lineWidth: width });
      context.stroke(path);
    }
  }

  const parts = AXES.map((axis, k) => {
    const figure = find(axis), [canvas, overlay] = figure.querySelectorAll("canvas");
    const [right, up] = [figure.dataset.right, figure.dataset.up].map((name) => AXES.indexOf(name));
    return { axis: k, right, up, canvas, overlay, slider: find("slice-" + axis), output: find("place-" + axis), figure };
  });

  function redraw() {
    asked = asked || requestAnimationFrame(show);
  }

  function show() {
    asked = 0;
    if (!bytes) return;
    const time_s = timeNow(), state = controlAt(time_s), words = inWords(time_s, 2) + " s";
    const longest_mm = Math.max(...parts.map((part) => draw(part, state))), times = arrows.valueAsNumber;
    find("time-value").textContent = words;
    time.setAttribute("aria-valuetext", words);
    find("arrows-value").textContent = times ? times + "×" : "none";
    arrows.setAttribute("aria-valuetext", find("arrows-value").textContent);
    reading.textContent = `At ${words} matter in these slices is at most ${longest_mm.toPrecision(2)} mm from its place in the reference.`;
  }

  for (const { figure, overlay, right, up } of parts) {
    figure.querySelector(".picture").addEventListener("pointerdown", (event) => {
      const box = overlay.getBoundingClientRect();
      const shares = [(event.clientX - box.left) / box.width, 1 - (event.clientY - box.top) / box.height];
      [right, up].forEach((k, i) => (parts[k].slider.value = Math.floor(clamp(shares[i], 0, 0.999999) * counts[k])));
      redraw();
    });
  }
  const player = makePlayer(find("play"), time, LASTS_MS, redraw);
  for (const slider of [time, arrows, ...parts.map((part) => part.slider)]) slider.addEventListener("input", redraw);
  find("reset").addEventListener("click", () => {
    player.stop();
    for (const slider of [time, arrows, ...parts.map((part) => part.slider)]) slider.value = slider.defaultValue;
    redraw();
  });
  document.addEventListener("grey-window", (event) => {
    ends = event.detail;
    redraw();
  });
  for (const { overlay } of parts) new ResizeObserver(redraw).observe(overlay);
  voxelsOf(volume).then((voxels) => {
    bytes = voxels;
    redraw();
  });
})();
