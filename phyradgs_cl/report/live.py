"""Writes the page of a run under way, whole and every few seconds. After the run it becomes the report.

``Status`` and ``Snapshot`` hold the words and pictures of the page, ``LivePage`` writes it."""

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
from phyradgs_cl.report.images import grey_range, middle_planes
from phyradgs_cl.report.markup import Markup, element, joined, json_block, label, number, raw_text
from phyradgs_cl.report.page import head, web_script
from phyradgs_cl.report.sections import facts_table, frame_pictures, note, section
from phyradgs_cl.report.viewer import stills
from phyradgs_cl.text import clock

_MOST_POINTS = 400  # most points of the convergence curve
_SAMPLES = 64  # most samples of the volume along each side from which the grey range is computed
# a run without news for this time, and for this many intervals between two versions of the page, may have been killed
_LATE_S, _LATE_TIMES = 30.0, 6
_LOG_RATIO = 20.0  # ratio of largest to smallest value above which the axis is logarithmic
_CHART = 560, 240  # width and height of the chart in pixels
_MARGIN = 64, 12, 12, 34  # margins of the chart in pixels: left, top, right, bottom
EVERY_S = 5.0  # time between two versions of the page
SHARE = 0.01  # largest fraction of the run's time that pictures may cost
FRAMES = 2  # number of frames that are computed from the volume and shown
FRAMES_FROM_S = 60.0  # no frames are computed in runs that are expected to take less time: their report comes soon


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The middle slices (axial, coronal, sagittal) of the volume after an iteration, in 1/mm, and some frames. high: the
    value of white in 1/mm."""

    iteration: int
    slices: tuple[NDArray[np.floating], ...]
    grid: Grid
    high: float
    frames: Sequence[FramePair] = ()

    @classmethod
    def of(cls, iteration: int, volume: NDArray[np.floating], grid: Grid, frames: Sequence[FramePair]) -> "Snapshot":
        slices = tuple(np.take(volume, n // 2, axis=axis) for axis, n in enumerate(volume.shape))
        sample = volume[tuple(slice(None, None, math.ceil(n / _SAMPLES)) for n in volume.shape)]
        return cls(iteration, slices, grid, max(grey_range(sample)[1], 0.0) or 1.0, frames)

    @cached_property
    def parts(self) -> list[Markup]:
        """The sections with pictures."""
        words = note(f"The middle slices after iteration {self.iteration}.")
        pictures = stills(middle_planes(self.slices, self.grid, (0.0, self.high)), "volume", self.high)
        parts = [section("slices", "Slices", words, pictures)]
        if self.frames:
            legend, rows = frame_pictures(self.frames)
            parts.append(section("projections", "Projections", note(legend), *rows))
        return parts


@dataclass(frozen=True, eq=False)
class Status:
    """What a page says about a run. Times are seconds since 1970.

    - settings: facts by name. stage: what the run does before its first iteration.
    - ended: the reason why no more news will come. It is no warning if ``is_complete``.
    - points: (iteration, measure of convergence)."""

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
    """Iteration, and time in s, of the present stage's first report, from which the rest of its time is estimated."""
    reported: float = 0.0
    snapshot: Snapshot | None = None

    def after(self, progress: Progress, now: float) -> "Status":
        """Returns the status after a report at ``now`` (s since 1970). Iterations that start again, as in a trial, start
        a new curve."""
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
        """Iterations per second, from the second report on; None before."""
        if self.progress is None or self.reported <= self.first[1] or self.progress.iteration <= self.first[0]:
            return None
        return (self.progress.iteration - self.first[0]) / (self.reported - self.first[1])

    def left_s(self, now: float) -> float | None:
        """Returns the time in s from ``now`` to the end of the last iteration; None before two reports."""
        if self.progress is None or self.per_s is None:
            return None
        return max(0.0, (self.progress.iterations - self.progress.iteration) / self.per_s - (now - self.reported))


def live_page(status: Status, now: float) -> str:
    """Returns the page as text, written at ``now`` in seconds since 1970."""
    pictures = [] if status.snapshot is None else status.snapshot.parts
    curve = [section("convergence", "Convergence", _curve(status))] if len(status.points) > 1 else []
    parts = [*pictures[:1], *curve, *pictures[1:], section("settings", "Settings", _settings(status))]
    names = ["slices", "convergence", "projections", "settings"]
    links = [element("a", n.capitalize(), href=f"#{n}") for n in names if any(f' id="{n}"' in part for part in parts)]
    skip = element("a", "To the content", href="#settings", class_="skip")
    data = {
        "written": now, "every_s": status.every_s, "late_s": max(_LATE_S, _LATE_TIMES * status.every_s),
        "is_over": bool(status.ended),
    }  # fmt: skip
    body = joined(
        skip, element("header", *_top(status, now), element("nav", *links, aria_label="Sections")),
        element("main", *parts), json_block("live-data", data),
    )
    script = web_script("common", "live")
    page = element("body", body, raw_text("script", script))
    seconds = None if status.ended else math.ceil(status.every_s)
    return "<!doctype html>\n" + element("html", head(_tab(status), script, seconds), page, lang="en") + "\n"


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
    controls = []
    if not status.ended:
        button = element("button", "Pause reloading", type="button", id="pause", aria_pressed="false")
        controls = [element("p", button, class_="tools")]
    tiles = [element("li", element("b", value), element("span", name)) for name, value in _tiles(status, now)]
    about = f"{status.settings.get('method', '')}, from {status.settings.get('scan', 'a scan')}"
    title = status.title if status.ended else f"{status.title}, under way"
    parts = [element("h1", title), element("p", about), news, element("p", words, id="written"), *controls]
    if (p := status.progress) is not None:
        parts.append(element("progress", value=p.iteration, max=max(p.iterations, 1), aria_label="Finished iterations"))
    return [*parts, element("ul", *tiles, class_="tiles")]


def _tiles(status: Status, now: float) -> list[tuple[str, str]]:
    tiles = []
    if (p := status.progress) is not None:
        tiles += [("iteration", f"{p.iteration} of {p.iterations}"), (p.quantity, number(p.loss))]
        if p.gaussians:
            tiles.append(("Gaussians", f"{p.gaussians:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")))
        if (per_s := status.per_s) is not None:
            tiles.append(("per minute", number(60 * per_s)))
        if (left_s := status.left_s(now)) is not None and not status.ended:
            tiles.append(("time left", clock(left_s)))
    return [*tiles, ("time so far", clock(now - status.started))]


def _settings(status: Status) -> Markup:
    tables = {name: facts for name, facts in status.settings.items() if isinstance(facts, Mapping)}
    plain = {name: value for name, value in status.settings.items() if name not in tables}
    parts = [facts_table(plain)]
    for name, facts in tables.items():
        parts += [element("h3", label(name).capitalize()), element("div", facts_table(facts), class_="columns")]
    return joined(*parts)


def _curve(status: Status) -> Markup:
    """Returns the convergence as SVG, drawn without matplotlib: its import would cost more than the run allows."""
    x, y = np.array(status.points, float).T
    words = status.progress.quantity if status.progress is not None else ""
    is_log = 0 < _LOG_RATIO * y.min() < y.max()
    height = np.log(y) if is_log else y
    left, top, right, bottom = _MARGIN
    across = left + (x - x[0]) / ((x[-1] - x[0]) or 1) * (_CHART[0] - left - right)
    down = _CHART[1] - bottom - (height - height.min()) / (np.ptp(height) or 1) * (_CHART[1] - top - bottom)
    path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, down, strict=True))
    ends = [(top + 4, y.max()), (_CHART[1] - bottom + 4, y.min())]
    base = _CHART[1] - bottom
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


log = logging.getLogger(__name__)


class LivePage:
    """Writes a page about a running method, as a listener to its progress. It is a context around the run.

    A thread writes the page every ``every_s`` seconds, so that an older page belongs to a run that was killed. Pictures
    are made between two iterations, as long as their time is below ``SHARE`` of the run's. An error, or Ctrl-C, leaves
    its reason on the page. An existing file is replaced at the first iteration, so that a refused run does not change it.
    A page that cannot be written gives one warning, and no error."""

    def __init__(self, path: Path, title: str, settings: Mapping[str, object], every_s: float = EVERY_S) -> None:
        self.path, self.every_s = path, every_s
        self.status = Status(title, settings, every_s, time.time())
        self.spent_s = 0.0
        """The time in s that the run has waited for pictures."""
        self._pictured_s = -every_s
        self._waits = False  # true until the first iteration
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
        """Sets the text on the page that says what the run does before its first iteration."""
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
        """Writes the page a last time, with the reason why no more news will come. Later calls do nothing."""
        if not self._is_over.is_set():
            self._stop()
            self.status = replace(self.status, ended=reason, is_complete=is_complete)
            self._write()

    def become(self, write_report: Callable[[Path], object]) -> None:
        """Replaces the page by the report that ``write_report`` writes. Where that fails, the page says how to make it."""
        self.stage("Writing the report")
        try:
            write_report(self.path)
            self._stop()
        except PhyradgsError as error:
            self._warn(f"no report: {error}")
            self.end("The run is complete. 'phyradgs report' makes its report.", is_complete=True)

    def _snapshot(self, progress: Progress, used_s: float) -> Snapshot:
        """Returns the present slices and frames. Frames that the device cannot compute are left out."""
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
