"use strict";
// What all scripts share: numbers as text, data blocks, and a camera that mouse, fingers and keys turn.
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const inWords = (value, decimals) => value.toFixed(decimals).replace(/^-(?=[0.]*$)/, "").replace("-", "−");
const bytesOf = (base64) => Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

function dataOf(id) {
  const block = document.getElementById(id);
  return block && JSON.parse(block.textContent);
}

// The bytes of the voxels, x fastest, from a picture that has the slices z side by side.
function voxelsOf(data) {
  return (voxelsOf.bytes ??= decodedVoxels(data));
}

async function decodedVoxels({ counts: [nx, ny, nz], atlas, columns }) {
  const image = new Image();
  image.src = "data:image/png;base64," + atlas;
  await image.decode();
  const { naturalWidth: width, naturalHeight: height } = image;
  const sheet = Object.assign(document.createElement("canvas"), { width, height });
  const context = sheet.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const bytes = new Uint8Array(nx * ny * nz);
  for (let z = 0; z < nz; z++) {
    const left = nx * (z % columns), top = ny * Math.floor(z / columns);
    const { data: pixels } = context.getImageData(left, top, nx, ny);
    for (let k = 0; k < nx * ny; k++) bytes[z * nx * ny + k] = pixels[4 * k];
  }
  return bytes;
}

// Lets a button move a slider to its end within some milliseconds; ``show`` draws its present position.
function makePlayer(button, slider, lasts_ms, show) {
  let playing = 0, started = 0;
  const share = () => slider.valueAsNumber / Number(slider.max);

  function stop() {
    cancelAnimationFrame(playing);
    playing = 0;
    button.textContent = "Play";
  }

  function step(now) {
    slider.value = ((now - started) / lasts_ms) * Number(slider.max);
    show();
    if (share() < 1) playing = requestAnimationFrame(step);
    else stop();
  }

  function start() {
    if (share() >= 1) slider.value = 0;
    started = performance.now() - share() * lasts_ms;
    button.textContent = "Pause";
    playing = requestAnimationFrame(step);
  }

  button.addEventListener("click", () => (playing ? stop() : start()));
  slider.addEventListener("input", stop);
  return { start, stop, isPlaying: () => playing !== 0 };
}

// Returns the largest of 1, 2, 5, 10, ... that is at most ``most``.
function roundLength(most) {
  const power = 10 ** Math.floor(Math.log10(most));
  return power * ([5, 2].find((factor) => factor * power <= most * (1 + 1e-9)) || 1);
}

// Sets the length and the text of a scale bar, from the picture's width.
function setBar(bar, width_mm) {
  const length = roundLength(0.3 * width_mm);
  bar.style.width = (100 * length) / width_mm + "%";
  bar.textContent = Number(length.toPrecision(1)) + " mm";
}

// A view from far away: parallel rays, so that lengths across it are true. turn, tilt in degrees; at 0 x is to the right, z up.
class Camera {
  constructor(turn, tilt, mostZoom) {
    this.initial = { turn, tilt, zoom: 1 };
    this.mostZoom = mostZoom;
    this.reset();
  }

  reset() {
    Object.assign(this, this.initial);
  }

  move(turn, tilt, times = 1) {
    this.turn = (((this.turn + turn) % 360) + 360) % 360;
    this.tilt = clamp(this.tilt + tilt, -90, 90);
    this.zoom = clamp(this.zoom * times, 1, this.mostZoom);
  }

  // Unit vectors in x, y, z: to the right and up in the picture, and towards the eye.
  axes() {
    const [a, e] = [-90 - this.turn, this.tilt].map((degrees) => (degrees * Math.PI) / 180);
    const towards = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const up = [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)];
    return { right: [-Math.sin(a), Math.cos(a), 0], up, towards };
  }
}

// Lets a canvas turn a camera. One finger turns about the axis, so that the page can be scrolled over the picture; two
// fingers tilt and zoom too. ``changed`` is called with true during a movement.
function makeTurnable(canvas, camera, changed) {
  const pointers = new Map();
  const spread = () => {
    const [a, b] = pointers.values();
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const share = 180 / canvas.clientWidth / pointers.size, before = pointers.size === 2 && spread();
    const across = (event.clientX - last.x) * share, down = (event.clientY - last.y) * share;
    Object.assign(last, { x: event.clientX, y: event.clientY });
    const mayTilt = event.pointerType !== "touch" || pointers.size === 2;
    camera.move(across, mayTilt ? down : 0, before ? spread() / before : 1);
    changed(true);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => pointers.delete(event.pointerId) && changed(false));
  }
  canvas.addEventListener(
    "wheel",
    (event) => {
      if (!event.ctrlKey) return; // without Ctrl the page scrolls
      event.preventDefault();
      camera.move(0, 0, 2 ** (-Math.sign(event.deltaY) / 4));
      changed(true);
    },
    { passive: false },
  );
  const steps = {
    ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, -5], ArrowDown: [0, 5],
    "+": [0, 0, 1.25], "=": [0, 0, 1.25], "-": [0, 0, 0.8],
  };
  canvas.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Home") camera.reset();
    else if (steps[event.key]) camera.move(...steps[event.key]);
    else return;
    event.preventDefault();
    changed(true);
  });
}
