// The page of a running reconstruction: loads itself again, and warns if the run has written nothing for too long.
(() => {
  const data = dataOf("live-data");
  if (!data || data.is_over) return;
  const news = document.getElementById("news"), pause = document.getElementById("pause");
  const written = new Date(1000 * data.written), clock = written.toLocaleTimeString([], { hour12: false });
  let isHeld = false; // by a finger or a button of the mouse

  // Kept when the page loads again: whether it is paused, and which element has the keyboard.
  let kept = {};
  try {
    kept = JSON.parse(sessionStorage.getItem("live") || "{}");
  } catch {} // a page opened as a file may have no storage
  const keep = (more) => {
    kept = { ...kept, ...more };
    try {
      sessionStorage.setItem("live", JSON.stringify(kept));
    } catch {}
  };

  function showPause() {
    pause.setAttribute("aria-pressed", String(!!kept.isPaused));
    pause.textContent = kept.isPaused ? "Resume reloading" : "Pause reloading";
  }

  function tick() {
    const age_s = (Date.now() - written) / 1000;
    if (age_s > data.late_s && !news.classList.contains("warning")) {
      news.textContent = `No news since ${clock}: the run may have been stopped.`;
      news.className = "warning";
      news.hidden = false;
      document.title = `no news – ${document.title}`;
    }
    const isDue = age_s > data.late_s ? sinceLoaded() > 3 * data.every_s : sinceLoaded() > data.every_s;
    if (isDue && !kept.isPaused && !isHeld && !getSelection().toString()) load();
  }

  const loaded = performance.now(), sinceLoaded = () => (performance.now() - loaded) / 1000;
  function load() {
    const link = document.activeElement.getAttribute("href");
    keep({ focus: document.activeElement.id ? "#" + document.activeElement.id : link && `a[href="${link}"]` });
    location.reload();
  }

  pause.addEventListener("click", () => {
    keep({ isPaused: !kept.isPaused });
    showPause();
  });
  document.addEventListener("pointerdown", () => (isHeld = true));
  for (const end of ["pointerup", "pointercancel"]) document.addEventListener(end, () => (isHeld = false));
  document.documentElement.classList.add("scripted");
  const focused = kept.focus && document.querySelector(kept.focus);
  if (focused) focused.focus({ preventScroll: true });
  showPause();
  tick();
  setInterval(tick, 500);
})();
