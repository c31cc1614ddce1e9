"""Writes a page about a run every few seconds. After the run the page becomes the report.

``Status`` and ``Snapshot`` are the page's words and pictures; ``LivePage`` writes it."""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.errors import PhyradgsError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import written_beside
from phyradgs_cl.reconstructors import Progress
from phyradgs_cl.reconstructors.projected import FramePair
from phyradgs_cl.report.images import grey_range, middle_planes, middle_slices
from phyradgs_cl.report.markup import Markup, element, grouped, joined, json_block, label, number, tiles
from phyradgs_cl.report.page import document, web_script
from phyradgs_cl.report.sections import facts_table, frame_pictures, note, section
from phyradgs_cl.report.viewer import stills
from phyradgs_cl.text import clock

log = logging.getLogger(__name__)
_MOST_POINTS = 400  # beyond this many points, every second one of the convergence curve is dropped
_SAMPLES = 64  # grey values are computed from at most this many voxels along each side, to save time
# a page that is older than both this time and this many of its intervals says that the run may have been killed
_LATE_S, _LATE_TIMES = 30.0, 6
_LOG_RATIO = 20.0  # the curve's axis is logarithmic if the largest value is more than this many times the smallest
_CHART = 560, 240  # width and height of the chart in pixels
_MARGIN = 64, 12, 12, 34  # margins of the chart in pixels: left, top, right, bottom
EVERY_S = 5.0  # time in s between two versions of the page
SHARE = 0.01  # fraction of the run's time that making pictures may take
FRAMES = 2  # frames that are computed from the volume and compared with the measured ones
FRAMES_FROM_S = 60.0  # runs shorter than this compute no frames, since their report comes soon


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Middle slices in 1/mm of the volume after an iteration, and measured and computed frames. high: white in 1/mm."""

    iteration: int
    slices: tuple[NDArray[np.floating], ...]
    grid: Grid
    high: float
    frames: Sequence[FramePair] = ()

    @classmethod
    def of(cls, iteration: int, volume: NDArray[np.floating], grid: Grid, frames: Sequence[FramePair]) -> "Snapshot":
        sample = volume[tuple(slice(None, None, math.ceil(n / _SAMPLES)) for n in volume.shape)]
        return cls(iteration, middle_slices(volume), grid, max(grey_range(sample)[1], 0.0) or 1.0, frames)

    @cached_property
    def parts(self) -> list[Markup]:
        """The page's sections with pictures: slices and, if there are any, frames."""
        words = note(f"The middle slices after iteration {self.iteration}.")
        pictures = stills(middle_planes(self.slices, self.grid, (0.0, self.high)), "volume", self.high)
        parts = [section("slices", "Slices", words, pictures)]
        if self.frames:
            legend, rows = frame_pictures(self.frames)
            parts.append(section("projections", "Projections", note(legend), *rows))
        return parts


@dataclass(frozen=True, eq=False)
class Status:
    """The words of a page about a run. Times are seconds since 1970.

    - settings: facts by name. stage: what the run does before its first iteration.
    - ended: why the run has ended; a warning unless ``is_complete``. points: (iteration, measure of convergence)."""

    title: str
    settings: Mapping[str, object]
    every_s: float
    started: float
    stage: str = ""
    ended: str = ""
    is_complete: bool = False
    progress: Progress | None = None
    points: tuple[tuple[int, float], ...] = ()
    first: tuple[int, float] = (0, 0.0)
    """Iteration and time in s of the present stage's first report, from which the speed is computed."""
    reported: float = 0.0
    snapshot: Snapshot | None = None

    def after(self, progress: Progress, now: float) -> "Status":
        """Returns the status after a report at ``now`` (s since 1970). If iterations start again, so does the curve."""
        last, points, first = self.progress, self.points, self.first
        is_same = last is not None and (last.quantity, last.iterations) == (progress.quantity, progress.iterations)
        if last is None or not is_same or progress.iteration < last.iteration:
            points, first = (), (progress.iteration, now)
        points = (*points, (progress.iteration, progress.loss))
        if len(points) > _MOST_POINTS:
            points = (*points[::2], points[-1])
        alone = replace(progress, state=None, volume=None, frames=None)
        return replace(self, progress=alone, points=points, first=first, reported=now, stage="")

    @property
    def per_s(self) -> float | None:
        """Iterations per second; None before the second report."""
        if self.progress is None or self.reported <= self.first[1] or self.progress.iteration <= self.first[0]:
            return None
        return (self.progress.iteration - self.first[0]) / (self.reported - self.first[1])

    def left_s(self, now: float) -> float | None:
        """Returns the time in s from ``now`` to the end of the last iteration; None before the second report."""
        if self.progress is None or self.per_s is None:
            return None
        return max(0.0, (self.progress.iterations - self.progress.iteration) / self.per_s - (now - self.reported))


def live_page(status: Status, now: float) -> str:
    """Returns the page's HTML. now: the time that it shows, in seconds since 1970."""
    pictures = [] if status.snapshot is None else status.snapshot.parts
    curve = [section("convergence", "Convergence", _curve(status))] if len(status.points) > 1 else []
    parts = [*pictures[:1], *curve, *pictures[1:], section("settings", "Settings", _settings(status))]
    names = ["slices", "convergence", "projections", "settings"]
    links = [name for name in names if any(f' id="{name}"' in part for part in parts)]
    data = {
        "written": now, "every_s": status.every_s, "late_s": max(_LATE_S, _LATE_TIMES * status.every_s),
        "is_over": bool(status.ended),
    }  # fmt: skip
    seconds, last = None if status.ended else math.ceil(status.every_s), json_block("live-data", data)
    script, top = web_script("common", "live"), _top(status, now)
    return document(_tab(status), script, top, links, "settings", parts, last, seconds)


def _tab(status: Status) -> str:
    p = status.progress
    share = "starting" if p is None else f"{100 * p.iteration // max(p.iterations, 1)} %"
    if status.ended:
        share = "complete" if status.is_complete else "stopped"
    return f"{share} – {status.title}"


def _top(status: Status, now: float) -> list[Markup]:
    at = time.strftime("%H:%M:%S", time.localtime(now))
    words = f"Written at {at}. " + ("" if status.ended else f"A run that is alive writes every {status.every_s:g} s.")
    state = status.ended or (f"{status.stage[:1].upper()}{status.stage[1:]}." if status.stage else "")
    kind = "warning" if status.ended and not status.is_complete else None
    news = element("p", state, id="news", role="status", class_=kind, hidden=not state)
    button = element("button", "Pause reloading", type="button", id="pause", aria_pressed="false")
    controls = [] if status.ended else [element("p", button, class_="tools")]
    about = f"{status.settings.get('method', '')}, from {status.settings.get('scan', 'a scan')}"
    title = status.title if status.ended else f"{status.title}, under way"
    parts = [element("h1", title), element("p", about), news, element("p", words, id="written"), *controls]
    if (p := status.progress) is not None:
        parts.append(element("progress", value=p.iteration, max=max(p.iterations, 1), aria_label="Finished iterations"))
    return [*parts, tiles(_facts(status, now))]


def _facts(status: Status, now: float) -> list[tuple[str, str]]:
    facts = []
    if (p := status.progress) is not None:
        facts += [("iteration", f"{p.iteration} of {p.iterations}"), (p.quantity, number(p.loss))]
        if p.gaussians:
            facts.append(("Gaussians", grouped(p.gaussians)))
        if (per_s := status.per_s) is not None:
            facts.append(("per minute", number(60 * per_s)))
        if (left_s := status.left_s(now)) is not None and not status.ended:
            facts.append(("time left", clock(left_s)))
    return [*facts, ("time so far", clock(now - status.started))]


def _settings(status: Status) -> Markup:
    tables = {name: facts for name, facts in status.settings.items() if isinstance(facts, Mapping)}
    plain = {name: value for name, value in status.settings.items() if name not in tables}
    parts = [facts_table(plain)]
    for name, facts in tables.items():
        parts += [element("h3", label(name).capitalize()), element("div", facts_table(facts), class_="columns")]
    return joined(*parts)


def _curve(status: Status) -> Markup:
    """Draws the convergence as SVG, without matplotlib, because its import would hold up the run."""
    x, y = np.array(status.points, float).T
    words = status.progress.quantity if status.progress is not None else ""
    is_log = 0 < _LOG_RATIO * y.min() < y.max()
    height = np.log(y) if is_log else y
    left, top, right, bottom = _MARGIN
    across = left + (x - x[0]) / ((x[-1] - x[0]) or 1) * (_CHART[0] - left - right)
    base = _CHART[1] - bottom
    down = base - (height - height.min()) / (np.ptp(height) or 1) * (base - top)
    path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, down, strict=True))
    ends = [(top + 4, y.max()), (base + 4, y.min())]
    texts = [element("text", number(value), x=left - 8, y=at, text_anchor="end") for at, value in ends]
    texts.append(element("text", number(x[0]), x=left, y=base + 20))
    texts.append(element("text", f"iteration {number(x[-1])}", x=_CHART[0] - right, y=base + 20, text_anchor="end"))
    frame = element("path", d=f"M{left},{top}V{base}H{_CHART[0] - right}", class_="frame")
    curve = element("polyline", points=path, class_="curve")
    caption = f"{words.capitalize()}: from {number(y[0])} to {number(y[-1])} at iteration {number(x[-1])}"
    caption += ", on a logarithmic axis." if is_log else "."
    drawing = element(
        "svg", frame, curve, *texts, viewBox=f"0 0 {_CHART[0]} {_CHART[1]}", role="img", aria_label=caption,
        class_="drawing plain",
    )
    return element("div", element("figure", drawing, element("figcaption", caption)), class_="charts")


class LivePage:
    """Writes a page about a run. Use a LivePage as a context manager around the run, and call it with each progress report.

    A thread writes the page every ``every_s`` seconds; a page that is much older shows that the run was killed. Pictures are
    made between two iterations, as long as they take less than ``SHARE`` of the run's time. An error or Ctrl-C leaves its
    reason on the page. An existing file is replaced at the first progress report, so that a refused run does not change it.
    A page that cannot be written gives one warning, and no error."""

    def __init__(self, path: Path, title: str, settings: Mapping[str, object], every_s: float = EVERY_S) -> None:
        self.path, self.every_s = path, every_s
        self.status = Status(title, settings, every_s, time.time())
        self.spent_s = 0.0  # the run has waited this long for pictures
        self._pictured_s = -every_s
        self._waits = False  # whether a file at ``path`` is kept until the first progress report
        self._started_s = time.monotonic()
        self._is_over = threading.Event()
        self._writer = threading.Thread(target=self._keep_writing, name="live page", daemon=True)
        self._warnings: set[str] = set()

    def __enter__(self) -> "LivePage":
        self._waits = self.path.exists()
        if not self._waits:
            self._begin()
        return self

    def _begin(self) -> None:
        self._waits = False
        self._write()
        self._writer.start()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if error is None:
            self.end("The run is complete.", is_complete=True)
        elif self._waits:
            return
        self.end(f"Stopped by an error: {error}" if isinstance(error, Exception) else "Interrupted.")

    def stage(self, text: str) -> None:
        """Says on the page what the run does before its first iteration."""
        self.status = replace(self.status, stage=text)

    def __call__(self, progress: Progress) -> None:
        self.status = self.status.after(progress, time.time())
        if self._waits:
            self._begin()
        used_s = time.monotonic() - self._started_s
        if progress.volume is None or used_s - self._pictured_s < self.every_s or self.spent_s > SHARE * used_s:
            return
        self.status = replace(self.status, snapshot=self._snapshot(progress, used_s))
        self._pictured_s = time.monotonic() - self._started_s
        self.spent_s += self._pictured_s - used_s

    def end(self, reason: str, is_complete: bool = False) -> None:
        """Writes the page for the last time, with the reason of the end. Later calls do nothing."""
        if not self._is_over.is_set():
            self._stop()
            self.status = replace(self.status, ended=reason, is_complete=is_complete)
            self._write()

    def become(self, write_report: Callable[[Path], object]) -> None:
        """Replaces the page by the report that ``write_report`` writes. If that fails, the page names the command for it."""
        self.stage("Writing the report")
        try:
            write_report(self.path)
            self._stop()
        except PhyradgsError as error:
            self._warn(f"no report: {error}")
            self.end("The run is complete. 'phyradgs report' makes its report.", is_complete=True)

    def _snapshot(self, progress: Progress, used_s: float) -> Snapshot:
        """Returns the present slices and frames; no frames if the run is short or the device cannot compute them."""
        assert progress.volume is not None
        frames: list[FramePair] = []
        expected_s = used_s * progress.iterations / max(progress.iteration, 1)
        if progress.frames is not None and expected_s >= FRAMES_FROM_S:
            try:
                frames = progress.frames(FRAMES)
            except PhyradgsError as error:
                self._warn(f"no frames on the live page: {error}")
        return Snapshot.of(progress.iteration, *progress.volume(), frames)

    def _keep_writing(self) -> None:
        while not self._is_over.wait(self.every_s):
            self._write()

    def _stop(self) -> None:
        self._is_over.set()
        if self._writer.is_alive():
            self._writer.join()

    def _write(self) -> None:
        try:
            page = live_page(self.status, time.time())
            with written_beside(self.path) as temporary:
                temporary.write_text(page, encoding="utf-8")
        except PhyradgsError as error:
            self._warn(f"no live page: {error}")

    def _warn(self, message: str) -> None:
        if message not in self._warnings:
            log.warning("%s", message)
        self._warnings.add(message)
