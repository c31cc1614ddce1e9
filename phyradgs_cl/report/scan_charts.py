"""Draws charts of a scan: its geometry from above and from the side, and when each detector line is exposed."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.acquisition import CircularOrbit, Scan
from phyradgs_cl.acquisition.altered.angles import middle_poses
from phyradgs_cl.acquisition.motion import Motion
from phyradgs_cl.acquisition.plot import draw_windows
from phyradgs_cl.drawing import ACCENT, BOX, EDGE, INK, SAMPLE, SOFT, round_length
from phyradgs_cl.report.charts import SIZE, chart, note
from phyradgs_cl.report.markup import Markup, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_FRAMES = 180  # about this many source positions are marked, even if there are more
_ARC_SAMPLES = 24  # number of poses along the first frame's arc
_FIRST_FRAMES = 4  # number of frames in the chart of successive frames
_MOST_DOTS = 600  # limit of the dots that mark the times and lines of a motion model's poses
_LINES_WITH_DOTS = 12  # at most so many detector lines have dots for their poses; more would merge
_BESIDE = 0.75  # a parallel beam's source and panel are drawn this many diagonals of the volume from its middle
_ROOM = 0.06  # margin around the data, as a fraction of their range
Points = NDArray[np.float64]


def orbit_chart(scan: Scan) -> Markup:
    """Returns a chart of the scanner from above: all source positions, the first frame's arc, rays, panel and volume. For a
    parallel beam, points on the middle ray stand for the source."""
    places = "directions of parallel rays" if scan.is_parallel else "source positions"
    words = f"{scan.frames} {places}; the first frame's rays, panel and volume"
    middles, arc = with_sources(scan, middle_poses(scan)), _first_arc(scan)
    first, last = (panel_corners(pose, scan.geometry.detector_shape)[:, :2] for pose in arc[[0, -1]])
    panel, later = (np.array([c[[0, 1]].mean(0), c[[2, 3]].mean(0)]) for c in (first, last))
    box = box_corners(scan)[:4, :2]

    def draw(axes: "Axes") -> None:
        axes.fill(*box.T, facecolor=BOX, edgecolor=SOFT)
        axes.plot(*middles[:: max(1, len(middles) // _MOST_FRAMES), :2].T, ".", color=SOFT, ms=4)
        _draw_rays(axes, panel, arc[0, :2], scan.is_parallel)
        axes.plot(*panel.T, color=INK, lw=4)
        if scan.is_fly:
            axes.plot(*later.T, color=INK, lw=4, alpha=0.3)
            axes.plot(*arc[:, :2].T, color=EDGE, lw=6, alpha=0.75)
        axes.plot(0, 0, "o", color=INK, ms=4)
        way = arc[0, :2] - arc[-1, :2]
        length = float(np.linalg.norm(way))
        shift = (0, 10) if length == 0 else (20 * way[0] / length, 20 * way[1] / length)
        _draw_source(axes, arc[0, :2], shift, scan.is_parallel)
        note(axes, "panel", panel[panel[:, 1].argmax()], (0, 8))

    return _plan(draw, (middles[:, :2], arc[:, :2], panel, later, box), "Geometry from above", words)


def side_chart(scan: Scan) -> Markup:
    """Returns a chart of the scanner from the side: source, rays, panel and volume in the plane of axis and central ray."""
    pose = _first_arc(scan)[0]
    corners = panel_corners(pose, scan.geometry.detector_shape)
    across = (corners.mean(0) - pose[:3])[:2]
    across = across / (np.linalg.norm(across) or 1.0)
    plane = np.array([[*across, 0.0], [0.0, 0.0, 1.0]]).T
    source, low, high = pose[:3] @ plane, corners[[0, 2]].mean(0) @ plane, corners[[1, 3]].mean(0) @ plane
    (left, bottom), (right, top) = (f(box_corners(scan) @ plane, axis=0) for f in (np.min, np.max))
    box = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    axis = np.array([[0.0, bottom], [0.0, top]]) * 1.25

    def draw(axes: "Axes") -> None:
        axes.fill(*box.T, facecolor=BOX, edgecolor=SOFT)
        axes.plot(*axis.T, "-.", color=SOFT, lw=1)
        _draw_rays(axes, np.array([low, high]), source, scan.is_parallel)
        axes.plot(*np.array([low, high]).T, color=INK, lw=4)
        _draw_source(axes, source, (0, 10), scan.is_parallel)
        note(axes, "panel", high, (0, 8))
        note(axes, "axis", axis[1], (0, 3))

    points = (source[None], low[None], high[None], box, axis)
    beam = "parallel rays" if scan.is_parallel else "source"
    return _plan(draw, points, "Geometry from the side", f"{beam}, axis, volume and panel")


def _draw_rays(axes: "Axes", panel: Points, source: Points, is_parallel: bool) -> None:
    """Draws the rays to a panel's two ends (2, 2). They start at the source or, in a parallel beam, side by side."""
    starts = panel + source - panel.mean(0) if is_parallel else (source, source)
    for start, end in zip(starts, panel, strict=True):
        axes.plot(*np.array([start, end]).T, color=ACCENT, alpha=0.55, lw=1)


def _draw_source(axes: "Axes", source: Points, shift: tuple[float, float], is_parallel: bool) -> None:
    if not is_parallel:
        axes.plot(*source, "o", color=ACCENT, ms=9)
    note(axes, "parallel rays" if is_parallel else "source", source, shift)


def _plan(draw: "Callable[[Axes], None]", points: Sequence[Points], title: str, words: str) -> Markup:
    """Returns a drawing to scale, in mm, with a scale bar and room for labels around ``points``, each (N, 2)."""
    every = np.concatenate(points)
    low, high = every.min(axis=0), every.max(axis=0)
    room = 0.1 * float(np.max(high - low)) or 1.0
    (left, bottom), (right, top) = low - room * np.array([1.0, 1.6]), high + room

    def scaled(axes: "Axes") -> None:
        draw(axes)
        bar_mm = round_length(0.25 * (right - left))
        ends, height = [left + 0.2 * room, left + 0.2 * room + bar_mm], bottom + 0.3 * room
        axes.plot(ends, [height, height], "|-", color=SOFT, lw=1)
        note(axes, f"{number(bar_mm)} mm", (np.mean(ends), height), (0, 4), color=SOFT, size="small")
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        axes.set_axis_off()

    return chart(scaled, title, words, (SIZE[0], SIZE[0] * (top - bottom) / (right - left)))


def with_sources(scan: Scan, poses: Points) -> Points:
    """Returns poses (..., 12) that can be drawn. A parallel beam has no source: a point on the middle ray in front of the
    volume takes its place, and the panel is put behind the volume."""
    if not scan.is_parallel:
        return poses
    away = poses[..., :3]
    middle = panel_corners(poses, scan.geometry.detector_shape).mean(0)
    reach_mm = _BESIDE * float(np.linalg.norm(scan.grid.size_mm))
    depth_mm = np.sum(middle * away, -1, keepdims=True)
    source, first = middle - (depth_mm + reach_mm) * away, poses[..., 3:6] + (reach_mm - depth_mm) * away
    return np.concatenate([source, first, poses[..., 6:]], -1)


def panel_corners(pose: Points, detector_shape: tuple[int, int]) -> Points:
    """Returns the panel's corners (4, ..., 3) in mm at poses (..., 12): left low, left high, right low, right high."""
    rows, columns = detector_shape
    u, v = np.array([-0.5, columns - 0.5]), np.array([-0.5, rows - 0.5])
    return np.array([pose[..., 3:6] + a * pose[..., 6:9] + b * pose[..., 9:12] for a in u for b in v])


def _first_arc(scan: Scan) -> Points:
    """Returns drawable poses (T, 12) at even times, from the first to the last light of a fly-scan's first frame. For a
    gantry at rest all poses are the same."""
    first_s, last_s = scan.shutter.lit_span_s if scan.is_fly else (scan.shutter.middle_s,) * 2
    times_s = scan.frame_start_s[0] + np.linspace(first_s, last_s, _ARC_SAMPLES)
    return with_sources(scan, scan.trajectory.pose(0, times_s))


def box_corners(scan: Scan) -> Points:
    """Returns the grid's corners (8, 3), x y z in mm: four around its bottom, then four around its top."""
    half, centre = np.array(scan.grid.size_mm[::-1]) / 2, np.array(scan.grid.offset_mm[::-1])
    around = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    return np.array([centre + half * (x, y, z) for z in (-1, 1) for x, y in around])


def shutter_chart(scan: Scan, motion: Motion | None) -> Markup:
    """Returns a chart of when each line of a frame is exposed (Fig. 3 of the paper), and of the poses' times."""
    return chart(lambda axes: draw_shutter(axes, scan, motion), "Shutter of one frame", shutter_words(scan))


def draw_shutter(axes: "Axes", scan: Scan, motion: Motion | None) -> None:
    """Draws when each line is exposed, the run's poses, the durations of exposure and readout, and the gantry's angle."""
    shutter, last = scan.shutter, max(scan.lines - 1, 1)
    draw_windows(axes, shutter, scan.lines)
    times_s, lines = (np.zeros(0), None) if motion is None else pose_times(scan, motion)
    if lines is not None:
        axes.plot(times_s, lines, ".", color=SAMPLE, ms=5)
    else:  # these poses hold for all lines
        for time_s in times_s:
            axes.axvline(time_s, color=ACCENT, ls="--", lw=1.2)
    ends = (0.0, float(last))[:: shutter.direction]
    above, below = (5, -14) if ends[0] < ends[1] else (-14, 5)
    _draw_span(axes, (0.0, shutter.exposure_s), ends[0], f"exposure {number(shutter.exposure_s)} s", below)
    if shutter.readout_s > 0:
        words = f"readout {number(shutter.readout_s)} s"
        _draw_span(axes, (shutter.exposure_s, shutter.span_s), ends[1], words, above)
    span_s = shutter.span_s or 1.0
    axes.set_xlim(-_ROOM * span_s, (1 + _ROOM) * span_s)
    axes.set_ylim(-2 * _ROOM * last, (1 + 2 * _ROOM) * last)
    for time_s, words in _gantry_words(scan):
        axes.text(time_s, 1.02, words, transform=axes.get_xaxis_transform(), ha="center", size="small", color=INK)


def frames_chart(scan: Scan) -> Markup:
    """Returns a chart of the first frames on one time axis, on which overlaps and pauses show."""
    start_s = np.asarray(scan.frame_start_s[:_FIRST_FRAMES]) - float(scan.frame_start_s[0])
    middle_s = (scan.shutter.delay_s(scan.lines).max() + scan.shutter.exposure_s) / 2

    def draw(axes: "Axes") -> None:
        for frame, first_s in enumerate(start_s):
            draw_windows(axes, scan.shutter, scan.lines, float(first_s))
            axes.text(first_s + middle_s, scan.lines / 2, str(frame), ha="center", weight="bold", color=INK)
        axes.set_xlabel("time (s)")

    return chart(draw, f"Exposure windows of the first {len(start_s)} frames", shutter_words(scan))


def shutter_words(scan: Scan) -> str:
    """Describes the shutter in words, without a full stop."""
    shutter = scan.shutter
    kind = "global shutter" if shutter.readout_s == 0 else f"rolling shutter along {shutter.axis}"
    words = f"{kind}: exposure {number(shutter.exposure_s)} s, readout {number(shutter.readout_s)} s"
    if shutter.direction < 0:
        words += ", last line first"
    if shutter.pulse_s is not None:
        words += f", beam on from {number(shutter.pulse_s[0])} s for {number(shutter.pulse_s[1])} s"
    return words


def pose_times(scan: Scan, motion: Motion) -> tuple[Points, Points | None]:
    """Returns the times (N,) of the first frame's poses, in s after its start, and their detector lines (N,), evenly chosen
    if there are many; None if poses hold for all lines. For segments in which Gaussians move, returns the segments' ends."""
    cells = motion.cells(scan, 0)
    if cells.is_moving:
        return np.linspace(*scan.shutter.lit_span_s, cells.count + 1), None
    times_s = cells.time_s - float(scan.frame_start_s[0])
    if cells.count == 1 or cells.line_share is not None:
        return times_s, None
    line = (cells.line_start + cells.line_stop - 1) / 2
    several = np.unique(line)
    some = several[np.linspace(0, len(several) - 1, min(len(several), _LINES_WITH_DOTS)).round().astype(int)]
    shown = np.flatnonzero(np.isin(line, some))[:_MOST_DOTS]
    return times_s[shown], line[shown]


def _draw_span(axes: "Axes", times_s: tuple[float, float], line: float, words: str, shift: float) -> None:
    axes.plot(times_s, [line, line], color=EDGE, lw=3)
    note(axes, words, (sum(times_s) / 2, line), (0, shift), size="small")


def _gantry_words(scan: Scan) -> list[tuple[float, str]]:
    """Returns (time, text) of the gantry's angle at start, middle and end of a frame; [] unless on a circular orbit."""
    if not isinstance(scan.trajectory, CircularOrbit):
        return []
    if not scan.is_fly:
        return [(scan.shutter.middle_s, "gantry stands")]
    times_s = np.unique([0.0, scan.shutter.span_s / 2, scan.shutter.span_s])
    angles_deg = np.rad2deg(scan.trajectory.angle_rad(0, scan.frame_start_s[0] + times_s))
    words = [f"{number(float(angle), 1e-4)}°" for angle in angles_deg]
    words[0] = f"gantry {words[0]}"
    return list(zip(times_s.tolist(), words, strict=True))
