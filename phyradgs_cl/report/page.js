"use strict";
// Sliders, pictures and cross lines of the three planes; without this script the middle slices stay.
(() => {
  const block = document.getElementById("slice-data");
  if (!block) return;
  const planes = JSON.parse(block.textContent);
  const parts = {};
  let layer = "result";

  // The share of the axis at which the middle of a plane's present slice lies.
  function share(axis) {
    const part = Object.values(parts).find((p) => p.plane.axis === axis);
    return (part.plane.indices[Number(part.slider.value)] + 0.5) / part.plane.count;
  }

  function draw() {
    for (const { plane, slider, picture, place, across, upwards } of Object.values(parts)) {
      const k = Number(slider.value);
      picture.src = "data:image/png;base64," + plane.layers[layer][k];
      place.textContent = plane.places[k];
      slider.setAttribute("aria-valuetext", plane.places[k]);
      upwards.style.left = 100 * share(plane.right) + "%";
      across.style.top = 100 - 100 * share(plane.up) + "%";
    }
  }

  function goTo(axis, where) {
    const { plane, slider } = Object.values(parts).find((p) => p.plane.axis === axis);
    const wanted = Math.min(Math.max(where, 0), 0.999999) * plane.count - 0.5;
    const gap = (index) => Math.abs(index - wanted);
    slider.value = plane.indices.reduce((best, index, k) => (gap(index) < gap(plane.indices[best]) ? k : best), 0);
  }

  function point(event, part) {
    const box = part.picture.getBoundingClientRect();
    goTo(part.plane.right, (event.clientX - box.left) / box.width);
    goTo(part.plane.up, 1 - (event.clientY - box.top) / box.height);
    draw();
  }

  for (const [name, plane] of Object.entries(planes)) {
    const figure = document.getElementById("plane-" + name);
    const part = {
      plane,
      slider: figure.querySelector("input"),
      picture: figure.querySelector("img"),
      place: figure.querySelector("output"),
      across: figure.querySelector(".across"),
      upwards: figure.querySelector(".upwards"),
    };
    parts[name] = part;
    part.slider.addEventListener("input", draw);
    const box = figure.querySelector(".picture");
    box.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      if (event.pointerType === "mouse") box.setPointerCapture(event.pointerId);
      point(event, part);
    });
    box.addEventListener("pointermove", (event) => {
      if (event.pointerType === "mouse" && event.buttons & 1) point(event, part);
    });
  }
  for (const button of document.querySelectorAll('input[name="layer"]')) {
    button.addEventListener("change", () => {
      layer = button.value;
      draw();
    });
    if (button.checked) layer = button.value; // a browser that comes back remembers the choice
  }
  document.documentElement.classList.add("scripted");
  draw();
})();
