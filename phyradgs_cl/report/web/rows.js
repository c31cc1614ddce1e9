// The first frame of a fly-scan in motion: every line at its own pose. Drawn without WebGL.
(() => {
  const data = dataOf("rows-data");
  if (!data) return;
  const find = (id) => document.getElementById(id);
  const canvas = find("rows"), time = find("rows-time"), play = find("rows-play"), reading = find("rows-reading");
  const camera = new Camera(data.turn_deg, data.tilt_deg, 8), context = canvas.getContext("2d");
  const [rows, columns] = data.shape, isRows = data.axis === "rows", count = isRows ? rows : columns;
  const [first_s, last_s] = data.times_s, LASTS_MS = 7000;
  const isStill = matchMedia("(prefers-reduced-motion: reduce)");
  let wasSeen = false, asked = 0;

  // Interpolates a value at a time from a list of values that covers the frame evenly.
  function between(list, time_s) {
    const at = clamp((time_s - first_s) / (last_s - first_s || 1), 0, 1) * (list.length - 1);
    const before = Math.min(Math.floor(at), list.length - 2), share = at - before;
    return list[before].map((value, k) => value + share * (list[before + 1][k] - value));
  }

  // The pose at a time: source, first pixel, steps of columns and rows, each x, y, z.
  function poseAt(time_s) {
    const pose = between(data.poses, time_s);
    return [0, 3, 6, 9].map((k) => pose.slice(k, k + 3));
  }

  // The two ends of a line, or of the panel's edge, at a pose.
  function ends([, pixel, across, up], line) {
    const along = isRows ? [[-0.5, line], [columns - 0.5, line]] : [[line, -0.5], [line, rows - 0.5]];
    return along.map(([u, v]) => pixel.map((value, k) => value + u * across[k] + v * up[k]));
  }

  const all = data.box.concat(...[first_s, (first_s + last_s) / 2, last_s].map((time_s) => {
    const pose = poseAt(time_s);
    return [pose[0], ...ends(pose, 0), ...ends(pose, count - 1)];
  }));
  const middle = [0, 1, 2].map((k) => (Math.min(...all.map((at) => at[k])) + Math.max(...all.map((at) => at[k]))) / 2);
  const reach = Math.max(...all.map((at) => Math.hypot(at[0] - middle[0], at[1] - middle[1]))); // across the axis
  const height = Math.max(...all.map((at) => Math.abs(at[2] - middle[2])));

  function draw() {
    asked = 0;
    const density = Math.min(devicePixelRatio, 2), wide = canvas.clientWidth, high = canvas.clientHeight;
    Object.assign(canvas, { width: Math.round(wide * density), height: Math.round(high * density) });
    context.scale(density, density);
    const style = getComputedStyle(canvas), colour = (name) => style.getPropertyValue("--" + name);
    const { right, up, towards } = camera.axes(), tall = height * Math.abs(up[2]);
    const scale = 0.47 * camera.zoom * Math.min(wide / reach, high / (tall + reach * Math.abs(towards[2])));
    const place = (at) => {
      const from = at.map((value, k) => value - middle[k]);
      return [wide / 2 + scale * dot(from, right), high / 2 - scale * dot(from, up)];
    };
    const stroke = (points, name, width, alpha = 1) => {
      context.globalAlpha = alpha;
      context.strokeStyle = colour(name);
      context.lineWidth = width;
      context.beginPath();
      points.forEach((at, k) => context[k ? "lineTo" : "moveTo"](...place(at)));
      context.stroke();
    };
    const spot = (at, name, radius) => {
      context.globalAlpha = 1;
      context.fillStyle = colour(name);
      context.beginPath();
      context.arc(...place(at), radius, 0, 2 * Math.PI);
      context.fill();
    };
    const now_s = timeNow(), pose = poseAt(now_s), box = data.box;
    stroke(data.poses.map((one) => one.slice(0, 3)), "soft", 1);
    for (let k = 0; k < 4; k++) {
      stroke([box[k], box[(k + 1) % 4], box[4 + ((k + 1) % 4)], box[4 + k], box[k]], "soft", 1, 0.6);
    }
    const lit = [];
    data.lines.forEach((line, k) => {
      const opens_s = data.opens_s[k], closes_s = data.closes_s[k];
      if (now_s >= closes_s) {
        const own = poseAt((opens_s + closes_s) / 2);
        stroke(ends(own, line), "accent", 2, 0.85);
        spot(own[0], "accent", 2);
      } else if (now_s < opens_s) stroke(ends(pose, line), "soft", 1, 0.55);
      else lit.push(line);
    });
    for (const line of lit) stroke(ends(pose, line), "edge", 3);
    for (const line of new Set([lit[0], lit[lit.length - 1]])) {
      if (line === undefined) continue;
      const [a, b] = ends(pose, line), back = (end) => end.map((value, k) => value + pose[0][k] - (a[k] + b[k]) / 2);
      for (const end of [a, b]) stroke([data.is_parallel ? back(end) : pose[0], end], "edge", 1, 0.8);
    }
    spot(pose[0], "edge", 5);
    say(now_s, lit.length);
  }

  const timeNow = () => first_s + (time.valueAsNumber / data.steps) * (last_s - first_s);

  function say(now_s, isLit) {
    const words = [`${inWords(now_s, 3)} s`];
    if (data.angles_deg) words.push(`gantry at ${inWords(between(data.angles_deg, now_s)[0], 2)}°`);
    const share = (part) => Math.round((100 * part) / data.lines.length);
    const read = data.closes_s.filter((closes_s) => now_s >= closes_s).length;
    find("rows-time-value").textContent = words[0];
    words.push(`${share(isLit)} % of the ${data.axis} exposed, ${share(read)} % read`);
    time.setAttribute("aria-valuetext", words.join(", "));
    reading.textContent = words.join(", ") + ".";
  }

  function redraw() {
    asked = asked || requestAnimationFrame(draw);
  }

  const player = makePlayer(play, time, LASTS_MS, draw);
  time.addEventListener("input", redraw);
  find("rows-reset").addEventListener("click", () => {
    player.stop();
    camera.reset();
    time.value = data.steps;
    redraw();
  });
  makeTurnable(canvas, camera, redraw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  new ResizeObserver(redraw).observe(canvas.parentElement);
  // The picture plays once, when it is first seen, unless the reader wants no motion.
  new IntersectionObserver(([entry]) => {
    if (entry.isIntersecting && !wasSeen && !isStill.matches) player.start();
    wasSeen = wasSeen || entry.isIntersecting;
    if (!entry.isIntersecting && player.isPlaying()) player.stop();
  }, { threshold: 0.5 }).observe(canvas);
})();
