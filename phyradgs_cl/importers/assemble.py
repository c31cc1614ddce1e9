"""The last steps of every importer: angles or poses and what is known about time make shutter, trajectory and opening
times; these, line integrals, geometry and options make a scan."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass
from functools import partial

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, FrameSweeps, PoseTable, Scan, Shutter
from phyradgs_cl.acquisition.geometry import Geometry, ParallelGeometry
from phyradgs_cl.acquisition.plausible import check_plausible
from phyradgs_cl.acquisition.trajectory import grid_of_scan, resting_poses
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.reading.frames import TAKEN, LineIntegrals

_log = logging.getLogger(__name__)
_OF_A_TURN = ("exposure_s", "readout_s", "angle_at", "readout_axis", "readout_direction")
Length = float | Callable[[], float]
Pitch = tuple[float, float] | Callable[[], tuple[float, float]]
_DISTANCES = ("source_to_axis_mm", "source_to_detector_mm")
_VIEW_DIGITS = 5  # of directions: views that agree to so many are one
_SLACK = 1e-6  # of a span: how far a table extends beyond the times that are needed


@dataclass(frozen=True, eq=False)
class Timing:
    """When frames were taken. ``start_s`` (F,): opening of the line that is read first; ``is_fly``: the gantry never
    stops; ``angle_at``: a stored angle belongs to the "start" or "middle" of the first line's exposure. ``assumed``:
    the values that neither file nor user stated, by their names in ``acquisition/plausible.py``."""

    shutter: Shutter
    start_s: np.ndarray
    is_fly: bool
    angle_at: str = "start"
    assumed: tuple[str, ...] = ()

    @property
    def angle_time_s(self) -> np.ndarray:
        """The times (F,) of the stored angles."""
        return self.start_s + (self.shutter.exposure_s / 2 if self.angle_at == "middle" else 0.0)


@dataclass(frozen=True, eq=False)
class StoredTiming:
    """The timing that a file states; None for missing values. ``start_s`` (F,): of a gantry that did not stop. ``written``:
    names of the values in a description that the user wrote, as against a file's header."""

    exposure_s: float | None = None
    readout_s: float | None = None
    frame_time_s: float | None = None
    start_s: np.ndarray | None = None
    axis: str | None = None
    direction: int | None = None
    pulse: tuple[float, float] | None = None  # in exposures, as the scanner's TOML gives it
    angle_at: str | None = None
    written: tuple[str, ...] = ()


def make_timing(
    subject: str, frames: int | np.ndarray, options: ImportOptions, stored: StoredTiming | None = None
) -> Timing:
    """Returns the timing of ``frames`` frames, or of those with these numbers (F,); options replace stored values. Start
    times, or a time from frame to frame, mean that the gantry turned continuously, which needs an exposure. Without them
    every frame was taken at rest, and options about a turn are refused."""
    stored, place = stored or StoredTiming(), np.arange(frames) if isinstance(frames, int) else frames
    exposure_s = _first(options.exposure_s, stored.exposure_s) or 0.0
    readout_s = _first(options.readout_s, stored.readout_s)
    axis = options.readout_axis or stored.axis
    direction = options.readout_direction or stored.direction
    angle_at = options.angle_at or stored.angle_at
    unstated = {"readout": readout_s, "axis": axis, "first": direction, "angles": angle_at}
    assumed = tuple(name for name, value in unstated.items() if value is None)
    start, length = stored.pulse or (0.0, 0.0)
    pulse_s = (start * exposure_s, length * exposure_s) if stored.pulse and exposure_s > 0 else None
    try:
        shutter = Shutter(exposure_s, readout_s or 0.0, axis or "rows", direction or 1, pulse_s)
    except InputError as error:
        if pulse_s is None:
            raise
        raise InputError(f"{subject} [beam] pulse_start", error.found, error.expected, error.remedy) from error
    angle_at = angle_at or "start"
    frame_time_s = _first(options.frame_time_s, stored.frame_time_s)
    if options.frame_time_s is None and stored.start_s is not None:
        start_s: np.ndarray = np.asarray(stored.start_s, np.float64)
        checks.shape(f"{subject} start times", start_s, place.shape)
    elif frame_time_s is not None:
        start_s = place * frame_time_s
    else:
        _check_rest(subject, shutter, options, stored)
        return Timing(shutter, place * max(shutter.span_s, 1.0), False, angle_at)
    _check_flight(subject, shutter, start_s, options)
    return Timing(shutter, start_s, True, angle_at, assumed)


def turning(geometry: Geometry, angle_rad: np.ndarray, timing: Timing) -> CircularOrbit:
    """Returns a circular orbit through gantry angles (F,). Each frame turns at the slope of the angles over time, one-sided
    at both ends; a frame at rest does not turn."""
    angle_rad = np.asarray(angle_rad, np.float64)
    exposure_s = timing.shutter.exposure_s
    if not timing.is_fly:
        return CircularOrbit(geometry, FrameSweeps(timing.start_s, exposure_s, angle_rad, angle_rad))
    unwrapped = np.unwrap(angle_rad)
    speed = np.gradient(unwrapped, timing.angle_time_s)
    first = unwrapped - speed * (timing.angle_time_s - timing.start_s)
    return CircularOrbit(geometry, FrameSweeps(timing.start_s, exposure_s, first, first + speed * exposure_s))


def _first(*values: float | None) -> float | None:
    return next((value for value in values if value is not None), None)


def _check_rest(subject: str, shutter: Shutter, options: ImportOptions, stored: StoredTiming) -> None:
    """Refuses options about a turn without a time from frame to frame; warns of a file's exposure."""
    turns = [name for name in options.given(_OF_A_TURN) if name != "exposure_s" or stored.exposure_s is None]
    asked = [options.called(name) for name in turns]
    frame_time = " or ".join(dict.fromkeys(map(options.named, ("frame_time_s", "fps"))))
    for name in (*asked, *stored.written):
        expected = "both, or neither for frames taken at rest"
        raise InputError(name, "no time from frame to frame beside it", expected, f"say {frame_time}")
    if shutter.exposure_s > 0:
        text = "%s: an exposure of %g s and no time from frame to frame: taken at rest; say %s if the gantry did not stop"
        _log.warning(text, subject, shutter.exposure_s, frame_time)


def _check_flight(subject: str, shutter: Shutter, start_s: np.ndarray, options: ImportOptions) -> None:
    if shutter.exposure_s <= 0:
        found = "none, with a gantry that does not stop"
        remedy = f"say {options.named('exposure_s')}, or leave the frame time out for frames taken at rest"
        raise InputError(f"{subject} exposure", found, "a time above 0 s", remedy)
    checks.finite(f"{subject} start times", start_s)
    if len(start_s) < 2 or np.any(np.diff(start_s) <= 0):
        found = f"{len(start_s)} frames" if len(start_s) < 2 else "start times that do not increase"
        raise InputError(f"{subject} start times", found, "at least two frames, one after the other in time")


@dataclass(frozen=True)
class Turned:
    """The flips of stored images after which v points up and u to the right, seen from the source."""

    rows: bool
    columns: bool

    def frames(self, array: np.ndarray) -> np.ndarray:
        """Returns frames or masks (..., v, u), flipped."""
        array = array[..., ::-1, :] if self.rows else array
        return array[..., ::-1] if self.columns else array

    def poses(self, pose: np.ndarray, panel: tuple[int, int]) -> np.ndarray:
        """Returns the poses (..., 12) of the flipped images."""
        pose = np.array(pose, np.float64)
        if self.rows:
            pose[..., 3:6] += (panel[0] - 1) * pose[..., 9:12]
            pose[..., 9:12] *= -1
        if self.columns:
            pose[..., 3:6] += (panel[1] - 1) * pose[..., 6:9]
            pose[..., 6:9] *= -1
        return pose


def turn_of(pose: np.ndarray) -> Turned:
    """Returns the flips of a stored image to row 0 below and column 0 left, from one of its poses (12,)."""
    source, step_u, step_v = pose[:3], pose[6:9], pose[9:12]
    right = np.array([-source[1], source[0], 0.0])
    return Turned(rows=bool(step_v[2] < 0), columns=bool(step_u @ right < 0))


def table_over_time(
    pose_at: Callable[[np.ndarray], np.ndarray], timing: Timing, subject: str, is_parallel: bool = False
) -> PoseTable:
    """Returns a pose table that covers every frame's window. ``pose_at``: poses (T, 12) at frame positions (T,), where 2.5
    is halfway from frame 2 to 3. A gantry at rest has each frame's pose at its middle."""
    if not timing.is_fly:
        at_s = np.asarray(timing.start_s) + timing.shutter.middle_s
        poses = pose_at(np.arange(len(at_s), dtype=np.float64))
        return resting_poses(poses, at_s, timing.shutter.span_s, f"{subject} poses", is_parallel)
    at_s = timing.angle_time_s
    span_s = timing.shutter.span_s
    before, after = at_s[0] - timing.start_s[0] + _SLACK * span_s, timing.start_s[-1] + span_s - at_s[-1]
    first = at_s[0] - max(before, 0.0)
    last = at_s[-1] + max(after, 0.0) + _SLACK * span_s
    time_s = np.concatenate([[first], at_s, [last]])
    position = np.concatenate([
        [-(at_s[0] - first) / (at_s[1] - at_s[0])],
        np.arange(len(at_s)),
        [len(at_s) - 1 + (last - at_s[-1]) / (at_s[-1] - at_s[-2])],
    ])  # fmt: skip
    return PoseTable(time_s, pose_at(position), f"{subject} poses", is_parallel)


def assemble_scan(
    integrals: LineIntegrals, trajectory: CircularOrbit | PoseTable, geometry: Geometry, timing: Timing,
    options: ImportOptions, *, title: str, source: str, grid: Grid | None = None,
    reference: np.ndarray | None = None, lag: float = 0.0, names: Mapping[str, str] | None = None, said: str = "",
) -> Scan:
    """Returns the scan of line integrals with row 0 the lowest; without a grid it gets the cone's cube. ``names``: names in
    messages about implausible values that a file states; ``said``: which frames were taken. InputError for such values, and
    for a scan most of whose views are one."""
    assumed = [*timing.assumed, *([] if options.detector_model else ["average"])] if timing.is_fly else []
    scan = Scan(
        projections=integrals.values, geometry=geometry, trajectory=trajectory, shutter=timing.shutter,
        frame_start_s=np.asarray(timing.start_s, np.float64),
        grid=grid or grid_of_scan(geometry, trajectory, timing.start_s),
        is_fly=timing.is_fly, detector_model=options.detector_model or "log", pixel_mask=integrals.mask,
        reference=reference, title=title,
        provenance={
            "imported_from": source, **integrals.applied, **({"assumed": assumed} if assumed else {}),
            TAKEN: "; ".join(str(part) for part in (said, integrals.applied.get(TAKEN)) if part),
        },
        lag=lag, saturation=integrals.saturation,
    )
    subjects = {"grid": f"{source} grid", "angles": f"{source} angles", **(names or {})}
    _check_turn(trajectory, scan.frame_start_s + timing.shutter.middle_s, subjects["angles"])
    is_timed = "exposure" not in assumed  # by convention an exposure of 1 s: the frame rate means nothing then
    check_plausible(scan, lambda name: subjects.get(name) or options.called(name), is_timed)
    scan.warn_of_near_panel()
    return scan


def _check_turn(trajectory: CircularOrbit | PoseTable, middle_s: np.ndarray, subject: str) -> None:
    """Raises InputError for most views at one angle, at times (F,): the angles are missing, or those of something else."""
    if isinstance(trajectory, PoseTable):
        views = trajectory.pose(0, middle_s)
        views = views / np.abs(views).max(axis=0, initial=1e-9)
    else:
        angle_rad = np.array([float(trajectory.angle_rad(i, at_s)) for i, at_s in enumerate(middle_s)])
        views = np.stack([np.cos(angle_rad), np.sin(angle_rad)], -1)
    count = len(views)
    most = int(np.unique(np.round(views, _VIEW_DIGITS) + 0.0, axis=0, return_counts=True)[1].max())
    if count > 1 and 2 * most > count:
        found = f"{most}{'' if most == count else f' of {count}'} views at one angle"
        raise InputError(subject, found, "a turn between the views", "correct the angles")


def names_in_file(options: ImportOptions, names: Mapping[str, str]) -> dict[str, str]:
    """Returns the file's names of those values that no option replaces, for messages."""
    return {field: name for field, name in names.items() if getattr(options, field, None) is None}


def with_options(options: ImportOptions, geometry: Geometry) -> Geometry:
    """Returns a geometry with the options' lengths where they are given. InputError for distances of a parallel beam."""
    if isinstance(geometry, ParallelGeometry):
        return parallel(options, *astuple(geometry))
    return cone(options, *astuple(geometry))


def parallel(
    options: ImportOptions, panel: tuple[int, int], pitch_mm: Pitch, offset_mm: tuple[float, float]
) -> ParallelGeometry:
    """Returns a parallel beam of a file's numbers, or the options' where they are given. InputError for distances."""
    for name in options.given(_DISTANCES):
        expected, remedy = "no distance: this file has a parallel beam", "leave it out"
        raise InputError(options.named(name), f"{getattr(options, name):g}", expected, remedy)
    return ParallelGeometry(panel, _pitch(options, pitch_mm), options.detector_offset_mm or offset_mm)


def cone(
    options: ImportOptions, to_axis_mm: Length, to_detector_mm: Length, panel: tuple[int, int], pitch_mm: Pitch,
    offset_mm: tuple[float, float], names: Mapping[str, str] | None = None,
) -> ConeGeometry:
    """Returns a geometry of a file's numbers, or the options' where they are given: functions that read numbers are called
    then only. ``names``: what the file calls them, see ``names_in_file``. InputError unless the panel stands behind the
    axis."""
    lengths = {"source_to_axis_mm": to_axis_mm, "source_to_detector_mm": to_detector_mm}
    to_axis_mm, to_detector_mm = (
        options.taken(name, length if callable(length) else partial(float, length)) for name, length in lengths.items()
    )
    if to_detector_mm <= to_axis_mm:
        axis, detector = ((names or {}).get(name) or options.named(name) for name in _DISTANCES)
        remedy = "are the two exchanged?"
        if names and not names.keys().isdisjoint(_DISTANCES):
            remedy += f" Correct the file, or say {' and '.join(map(options.named, _DISTANCES))}"
        raise InputError(detector, f"{to_detector_mm:g}", f"more than {axis} ({to_axis_mm:g})", remedy)
    offset_mm = options.detector_offset_mm or offset_mm
    return ConeGeometry(to_axis_mm, to_detector_mm, panel, _pitch(options, pitch_mm), offset_mm)


def _pitch(options: ImportOptions, stored: Pitch) -> tuple[float, float]:
    return options.taken("pixel_size_mm", stored if callable(stored) else lambda: stored)
