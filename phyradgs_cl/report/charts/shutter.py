"""Space and time: which detector line sees light when (the paper's Fig. 3), in one frame and in successive ones."""

import numpy as np

from phyradgs_cl.acquisition import (
    CircularOrbit,
    LineMiddles,
    MicroViews,
    Motion,
    OwnTimes,
    PerRow,
    Scan,
    StaticStart,
)
from phyradgs_cl.report.charts.axes import TOP, Axes, svg, text
from phyradgs_cl.report.facts import number
from phyradgs_cl.report.markup import Markup, element, joined

_MOST_DOTS, _MOST_CELLS = 600, 100_000
_LINES_WITH_DOTS = 12  # per-row times are shown for so many lines
_FRAMES = 4
_ROOM = 0.06  # beside the data, as a share of them


def shutter_drawing(scan: Scan, motion: Motion | None) -> Markup:
    """One frame: the parallelogram of exposures, lit part and pulse, and the times at which the run took its poses."""
    shutter, last = scan.shutter, max(scan.lines - 1, 1)
    span_s = shutter.span_s or 1.0
    axes = Axes((-_ROOM * span_s, (1 + _ROOM) * span_s), (-2 * _ROOM * last, last * (1 + 2 * _ROOM)))
    drawn = joined(
        axes.frame("time after the frame's start (s)", f"detector {shutter.axis[:-1]}"),
        *_windows(axes, scan, 0.0),
        *(_sampling(axes, scan, motion) if motion is not None else []),
        *_spans(axes, scan),
        _angles(axes, scan),
    )
    return svg(drawn, "Shutter of one frame", shutter_words(scan))


def frames_drawing(scan: Scan) -> Markup:
    """The first frames on one axis of time, so that overlap or pauses between them show."""
    count = min(_FRAMES, scan.frames)
    start_s = np.asarray(scan.frame_start_s[:count]) - float(scan.frame_start_s[0])
    low_s, high_s = float(start_s.min()), float(start_s.max()) + (scan.shutter.span_s or 1.0)
    room_s, last = _ROOM * (high_s - low_s), max(scan.lines - 1, 1)
    axes = Axes((low_s - room_s, high_s + room_s), (-_ROOM * last, last * (1 + _ROOM)))
    windows = [w for s in start_s for w in _windows(axes, scan, float(s))]
    middle_s = scan.shutter.delay_s(scan.lines).max() / 2 + scan.shutter.exposure_s / 2
    names = [axes.text(s + middle_s, last / 2, str(k), class_="strong over") for k, s in enumerate(start_s)]
    drawn = joined(axes.frame("time (s)", f"detector {scan.shutter.axis[:-1]}"), *windows, *names)
    return svg(drawn, f"Exposure windows of the first {count} frames", shutter_words(scan))


def shutter_words(scan: Scan) -> str:
    """The shutter in a sentence."""
    shutter = scan.shutter
    kind = "global shutter" if shutter.readout_s == 0 else f"rolling shutter along {shutter.axis}"
    words = f"{kind}: exposure {number(shutter.exposure_s)} s, readout {number(shutter.readout_s)} s"
    if shutter.direction < 0:
        words += ", last line first"
    if shutter.pulse_s is not None:
        words += f", beam on from {number(shutter.pulse_s[0])} s for {number(shutter.pulse_s[1])} s"
    return words


def _windows(axes: Axes, scan: Scan, start_s: float) -> list[Markup]:
    """The open windows of all lines, and over them, with a pulsed beam, their lit parts."""
    shutter, lines = scan.shutter, np.arange(scan.lines)
    opens = shutter.delay_s(scan.lines)
    shapes = [(np.stack([opens, opens + shutter.exposure_s], -1), "open" if shutter.pulse_s else "lit")]
    if shutter.pulse_s is not None:
        shapes.append((shutter.line_windows_s(scan.lines), "lit"))
    drawn = []
    for windows, class_ in shapes:
        kept = np.unique(np.linspace(0, scan.lines - 1, 129).round().astype(int))  # corners of a pulse are few
        ends = [(r, 0) for r in kept] + [(r, 1) for r in kept[::-1]]
        outline = [(start_s + float(windows[r, end]), float(lines[r])) for r, end in ends]
        drawn.append(axes.polygon(outline, class_))
    return drawn


def _sampling(axes: Axes, scan: Scan, motion: Motion) -> list[Markup]:
    """When the run took its poses: a line for one per frame, edges of segments, or dots on lines."""
    bottom, top = axes.y
    if isinstance(motion, MicroViews | OwnTimes | LineMiddles) and scan.is_fly:
        return [axes.dot(time_s, line, "sample") for time_s, line in _sample_times(scan, motion)]
    first_s, last_s = scan.shutter.lit_span_s
    cells = motion.cells(scan, 0)
    at_s: list[float] = [first_s if isinstance(motion, StaticStart) else scan.shutter.middle_s]
    if isinstance(motion, PerRow) and scan.is_fly:
        at_s = (cells.time_s - float(scan.frame_start_s[0])).tolist()
    elif cells.is_moving:
        at_s = np.linspace(first_s, last_s, cells.count + 1).tolist()
    return [axes.polyline([(t, bottom), (t, top)], "pose") for t in at_s]


def _sample_times(scan: Scan, motion: Motion) -> list[tuple[float, float]]:
    """(time after the frame's start, line) of the poses, of some of the lines where every line has its own."""
    rows = min(motion.strips, scan.lines) if isinstance(motion, MicroViews) else scan.lines
    if rows * getattr(motion, "sub_intervals", 1) > _MOST_CELLS:
        return []
    cells = motion.cells(scan, 0)
    line = (cells.line_start + cells.line_stop - 1) / 2
    shown = np.ones(cells.count, bool)
    if not isinstance(motion, MicroViews):
        shown = np.isin(line, np.unique(np.linspace(0, scan.lines - 1, _LINES_WITH_DOTS).round()))
    times_s = cells.time_s - float(scan.frame_start_s[0])
    return [(float(times_s[c]), float(line[c])) for c in np.flatnonzero(shown)[:_MOST_DOTS]]


def _spans(axes: Axes, scan: Scan) -> list[Markup]:
    """How long a line is open, and how long the panel reads: two bars at the first-read and last-read line."""
    shutter = scan.shutter
    first, last = (0.0, float(max(scan.lines - 1, 1)))[:: shutter.direction]
    below, above = (14, -7) if first < last else (-7, 14)
    drawn = _span(axes, (0.0, shutter.exposure_s), first, f"exposure {number(shutter.exposure_s)} s", below)
    words = f"readout {number(shutter.readout_s)} s"
    return drawn + _span(axes, (shutter.exposure_s, shutter.span_s), last, words, above) * (shutter.readout_s > 0)


def _span(axes: Axes, times_s: tuple[float, float], line: float, words: str, shift: float) -> list[Markup]:
    bar = axes.polyline([(times_s[0], line), (times_s[1], line)], "span")
    return [bar, axes.text(sum(times_s) / 2, line, words, shift=(0, shift), class_="small")]


def _angles(axes: Axes, scan: Scan) -> Markup | None:
    """The gantry's angle at the window's ends, above the chart, where it has one."""
    if not isinstance(scan.trajectory, CircularOrbit):
        return None
    if not scan.is_fly:
        return text(axes.at(scan.shutter.middle_s, axes.y[1])[0], TOP - 16, "gantry stands", class_="small")
    times_s = np.unique([0.0, scan.shutter.span_s / 2, scan.shutter.span_s])
    angles = np.rad2deg(scan.trajectory.angle_rad(0, scan.frame_start_s[0] + times_s))
    words = [f"{'gantry ' if k == 0 else ''}{number(float(a), 1e-4)}°" for k, a in enumerate(angles)]
    places = [axes.at(float(t), axes.y[1])[0] for t in times_s]
    return element("g", *(text(x, TOP - 16, w, class_="small") for x, w in zip(places, words, strict=True)))
