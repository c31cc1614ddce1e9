"""The last steps of every importer: computes the shutter, the frames' opening times and the trajectory, and makes the scan.

``RotaryStage`` describes a sample that turns between a source and a panel at rest. Its axis may miss the central ray."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, FrameSweeps, PoseTable, Scan, Shutter
from phyradgs_cl.acquisition.altered.angles import middle_poses
from phyradgs_cl.acquisition.geometry import Geometry, ParallelGeometry, plain_geometry
from phyradgs_cl.acquisition.plausible import check_plausible, question_unit
from phyradgs_cl.acquisition.trajectory import grid_of_scan, resting_poses, unwrapped
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers.frames import TAKEN, LineIntegrals, line_integrals, oriented
from phyradgs_cl.importers.options import ImportOptions

_log = logging.getLogger(__name__)
_OF_A_TURN = ("exposure_s", "readout_s", "angle_at", "readout_axis", "readout_direction")
Length = Any  # a number, or a function that reads it
Pitch = Any  # a pair of numbers (v, u), or a function that reads it
DISTANCES = ("source_to_axis_mm", "source_to_detector_mm")
_VIEW_DIGITS = 5  # two views are equal if their poses, as fractions of the largest, agree to so many decimals
_SLACK = 1e-6  # pose tables extend by this fraction of a frame's duration beyond the frames, for times that are rounded


@dataclass(frozen=True, eq=False)
class Timing:
    """Shutter and times of a scan's frames. start_s (F,): time in s at which each frame's first line opens. is_fly: whether
    the gantry never stops. angle_at: a stored angle holds at the "start" or in the "middle" of its first line's exposure.
    assumed: names, as in ``acquisition/plausible.py``, of values that neither file nor user stated."""

    shutter: Shutter
    start_s: np.ndarray
    is_fly: bool
    angle_at: str = "start"
    assumed: tuple[str, ...] = ()

    @property
    def angle_time_s(self) -> np.ndarray:
        """The times (F,) in s at which the stored angles hold."""
        return self.start_s + (self.shutter.exposure_s / 2 if self.angle_at == "middle" else 0.0)


@dataclass(frozen=True, eq=False)
class StoredTiming:
    """The timing that a file states; None for missing values. start_s (F,): opening times in s of a fly-scan's frames. axis,
    direction: of the readout. written: names of values that a user wrote into the description; () for a scanner's header.
    clock: words of what the file says about the frames' times, which does not say whether the gantry turned meanwhile."""

    exposure_s: float | None = None
    readout_s: float | None = None
    frame_time_s: float | None = None
    start_s: np.ndarray | None = None
    axis: str | None = None
    direction: int | None = None
    pulse: tuple[float, float] | None = None  # start and length of the beam's pulse, as fractions of the exposure
    angle_at: str | None = None
    written: tuple[str, ...] = ()
    clock: str = ""


def make_timing(
    subject: str, frames: int | np.ndarray, options: ImportOptions, stored: StoredTiming | None = None
) -> Timing:
    """Returns the timing of ``frames``: a count, or the frames' numbers (F,). Options replace stored values. With start
    times or a frame time (from start to start) the scan is a fly-scan. Without both, every frame was taken at rest.

    Raises InputError for a fly-scan without an exposure, with fewer than two frames, or with start times that do not rise.
    Raises it also for options about the exposure or readout of frames at rest, and for a pulse outside the exposure."""
    stored, place = stored or StoredTiming(), np.arange(frames) if isinstance(frames, int) else frames
    exposure_s, readout_s, frame_time_s = (
        getattr(stored, name) if getattr(options, name) is None else getattr(options, name)
        for name in ("exposure_s", "readout_s", "frame_time_s")
    )
    axis, direction = options.readout_axis or stored.axis, options.readout_direction or stored.direction
    angle_at = options.angle_at or stored.angle_at
    unstated = {"readout": readout_s, "axis": axis, "first": direction, "angles": angle_at}
    assumed = tuple(name for name, value in unstated.items() if value is None)
    pulse_s = (stored.pulse[0] * exposure_s, stored.pulse[1] * exposure_s) if stored.pulse and exposure_s else None
    try:
        shutter = Shutter(exposure_s or 0.0, readout_s or 0.0, axis or "rows", direction or 1, pulse_s)
    except InputError as error:
        if pulse_s is None:
            raise
        raise InputError(f"{subject} [beam] pulse_start", error.found, error.expected, error.remedy) from error
    if options.frame_time_s is None and stored.start_s is not None:
        start_s = np.asarray(stored.start_s, np.float64)
        checks.shape(f"{subject} start times", start_s, place.shape)
    elif frame_time_s is not None:
        start_s = place * frame_time_s
    else:
        _check_rest(subject, shutter, options, stored)
        return Timing(shutter, place * max(shutter.span_s, 1.0), False, angle_at or "start")
    if shutter.exposure_s <= 0:
        remedy = f"say {options.named('exposure_s')}, or leave the frame time out for frames taken at rest"
        raise InputError(f"{subject} exposure", "none, with a gantry that does not stop", "a time above 0 s", remedy)
    if len(start_s) < 2 or not np.all(np.diff(start_s) > 0):
        found = f"{len(start_s)} frames" if len(start_s) < 2 else "start times that do not increase"
        raise InputError(f"{subject} start times", found, "at least two frames, one after the other in time")
    return Timing(shutter, start_s, True, angle_at or "start", assumed)


def turning(geometry: Geometry, angle_rad: np.ndarray, timing: Timing) -> CircularOrbit:
    """Returns a circular orbit through gantry angles (F,) in rad. The gantry's speed during a frame is the central
    difference of the angles over time, one-sided in the first and the last frame. Frames taken at rest keep one angle."""
    angle_rad = np.asarray(angle_rad, np.float64)
    exposure_s = timing.shutter.exposure_s
    if not timing.is_fly:
        return CircularOrbit(geometry, FrameSweeps(timing.start_s, exposure_s, angle_rad, angle_rad))
    turned_rad = unwrapped(angle_rad)
    speed = np.gradient(turned_rad, timing.angle_time_s)
    first = turned_rad - speed * (timing.angle_time_s - timing.start_s)
    return CircularOrbit(geometry, FrameSweeps(timing.start_s, exposure_s, first, first + speed * exposure_s))


def _check_rest(subject: str, shutter: Shutter, options: ImportOptions, stored: StoredTiming) -> None:
    """Raises InputError for options, and values written into a description, that only a fly-scan has. Warns of an exposure,
    which hints at a fly-scan without a frame time."""
    turns = [name for name in options.given(_OF_A_TURN) if name != "exposure_s" or stored.exposure_s is None]
    frame_time = " or ".join(dict.fromkeys(map(options.named, ("frame_time_s", "fps"))))
    for name in (*map(options.called, turns), *stored.written):
        expected = "both, or neither for frames taken at rest"
        raise InputError(name, "no time from frame to frame beside it", expected, f"say {frame_time}")
    if shutter.exposure_s > 0 or stored.clock:
        exposure = f"an exposure of {shutter.exposure_s:g} s" if shutter.exposure_s > 0 else "no exposure"
        text = "%s: %s and %s: taken at rest; say %s if the gantry did not stop"
        _log.warning(text, subject, exposure, stored.clock or "no time from frame to frame", frame_time)


@dataclass(frozen=True)
class Turned:
    """Tells which axes of a stored image to reverse, so that v points up and u to the right, seen from the source."""

    rows: bool
    columns: bool

    def frames(self, array: np.ndarray) -> np.ndarray:
        """Returns frames or masks (..., v, u), reversed along v if ``rows`` and along u if ``columns``."""
        array = array[..., ::-1, :] if self.rows else array
        return array[..., ::-1] if self.columns else array

    def poses(self, pose: np.ndarray, panel: tuple[int, int]) -> np.ndarray:
        """Converts stored images' poses (..., 12), see ``PoseTable``, to the reversed images'. panel: (rows, columns)."""
        pose = np.array(pose, np.float64)
        sides = (self.rows, panel[0], slice(9, 12)), (self.columns, panel[1], slice(6, 9))
        for count, step in ((count, step) for is_flipped, count, step in sides if is_flipped):
            pose[..., 3:6] += (count - 1) * pose[..., step]
            pose[..., step] *= -1
        return pose


def turn_of(pose: np.ndarray) -> Turned:
    """Finds the flips that put row 0 at the bottom and column 0 on the left. pose (12,): see ``PoseTable``."""
    source, step_u, step_v = pose[:3], pose[6:9], pose[9:12]
    right = np.array([-source[1], source[0], 0.0])
    return Turned(rows=bool(step_v[2] < 0), columns=bool(step_u @ right < 0))


def table_over_time(
    pose_at: Callable[[np.ndarray], np.ndarray], timing: Timing, subject: str, panel: tuple[int, int],
    is_parallel: bool = False,
) -> tuple[PoseTable, Geometry]:
    """Returns a pose table from the first frame's opening to the last line's closing of the last frame, and the nearest
    circular geometry. pose_at: returns poses (T, 12) at frame positions (T,), where 2.5 is halfway from frame 2 to 3. At
    rest, every frame has one pose. panel: the image's (rows, columns)."""
    poses = pose_at(np.arange(len(timing.start_s), dtype=np.float64))
    geometry = plain_geometry(poses, panel, is_parallel)
    if not timing.is_fly:
        at_s = np.asarray(timing.start_s) + timing.shutter.middle_s
        return resting_poses(poses, at_s, timing.shutter.span_s, f"{subject} poses", is_parallel), geometry
    at_s, span_s = timing.angle_time_s, timing.shutter.span_s
    before_s = max(at_s[0] - timing.start_s[0] + _SLACK * span_s, 0.0)
    after_s = max(timing.start_s[-1] + span_s - at_s[-1], 0.0) + _SLACK * span_s
    time_s = np.concatenate([[at_s[0] - before_s], at_s, [at_s[-1] + after_s]])
    first, last = -before_s / (at_s[1] - at_s[0]), len(at_s) - 1 + after_s / (at_s[-1] - at_s[-2])
    position = np.concatenate([[first], np.arange(len(at_s)), [last]])
    return PoseTable(time_s, pose_at(position), f"{subject} poses", is_parallel), geometry


def assemble_scan(
    integrals: LineIntegrals, trajectory: CircularOrbit | PoseTable, geometry: Geometry, timing: Timing,
    options: ImportOptions, path: Path, *, title: str = "", grid: Grid | None = None,
    reference: np.ndarray | None = None, lag: float = 0.0, names: Mapping[str, str] | None = None, said: str = "",
) -> Scan:
    """Returns a scan of line integrals whose row 0 is the lowest. grid: None takes ``grid_of_scan``. reference, lag: see
    ``Scan``. names: what the file calls its values, for messages. said: a text that says which frames were read. Raises
    InputError for implausible values, and if more than half of the views have the same pose."""
    assumed = [*timing.assumed, *([] if options.detector_model else ["average"])] if timing.is_fly else []
    scan = Scan(
        projections=integrals.values, geometry=geometry, trajectory=trajectory, shutter=timing.shutter,
        frame_start_s=np.asarray(timing.start_s, np.float64),
        grid=grid or grid_of_scan(geometry, trajectory, timing.start_s),
        is_fly=timing.is_fly, detector_model=options.detector_model or "log", pixel_mask=integrals.mask,
        reference=reference, title=title or path.stem,
        provenance={
            "imported_from": str(path), **integrals.applied, **({"assumed": assumed} if assumed else {}),
            TAKEN: "; ".join(str(part) for part in (said, integrals.applied.get(TAKEN)) if part),
        },
        lag=lag, saturation=integrals.saturation,
    )
    subjects = {"grid": f"{path} grid", "angles": f"{path} angles", **(names or {})}
    _check_turn(middle_poses(scan), options.called("angles", subjects))
    is_timed = "exposure" not in assumed  # an assumed exposure of 1 s gives no frame rate that can be checked
    check_plausible(scan, lambda name: options.called(name, subjects), is_timed)
    scan.warn_of_near_panel()
    return scan


def _check_turn(poses: np.ndarray, subject: str) -> None:
    """Raises InputError if more than half of the views have the same pose. poses (F, 12): in the middle of each frame."""
    views, count = poses / np.abs(poses).max(axis=0, initial=1e-9), len(poses)
    most = int(np.unique(np.round(views, _VIEW_DIGITS) + 0.0, axis=0, return_counts=True)[1].max())
    if count > 1 and 2 * most > count:
        found = f"{most}{'' if most == count else f' of {count}'} views at one angle"
        raise InputError(subject, found, "a turn between the views", "correct the angles")


def with_options(options: ImportOptions, geometry: Geometry) -> Geometry:
    """Replaces a geometry's lengths by the lengths that options give. Raises InputError for distances of a parallel beam."""
    return (parallel if isinstance(geometry, ParallelGeometry) else cone)(options, *astuple(geometry))


def parallel(
    options: ImportOptions, panel: tuple[int, int], pitch_mm: Pitch, offset_mm: tuple[float, float]
) -> ParallelGeometry:
    """Returns the geometry of a parallel beam. Options replace the file's pitch and offset, both (v, u) in mm. Raises
    InputError if an option gives a distance of the source."""
    for name in options.given(DISTANCES):
        expected, remedy = "no distance: this file has a parallel beam", "leave it out"
        raise InputError(options.named(name), f"{getattr(options, name):g}", expected, remedy)
    return ParallelGeometry(panel, options.taken("pixel_size_mm", pitch_mm), options.detector_offset_mm or offset_mm)


def cone(
    options: ImportOptions, to_axis_mm: Length, to_detector_mm: Length, panel: tuple[int, int], pitch_mm: Pitch,
    offset_mm: tuple[float, float], names: Mapping[str, str] | None = None,
) -> ConeGeometry:
    """Returns the geometry of a cone beam. Options replace the file's values, which are the other arguments. A length or
    pitch may be a function that reads it. The function is called only if no option replaces its value. names: what the file
    calls its values, for messages. Raises InputError unless the distance to the detector exceeds that to the axis."""
    axis_mm, detector_mm = map(options.taken, DISTANCES, (to_axis_mm, to_detector_mm))
    if detector_mm <= axis_mm:
        axis, detector = (options.called(name, names) for name in DISTANCES)
        remedy = "are the two exchanged?"
        if names and not names.keys().isdisjoint(DISTANCES):
            remedy += f" Correct the file, or say {' and '.join(map(options.named, DISTANCES))}"
        raise InputError(detector, f"{detector_mm:g}", f"more than {axis} ({axis_mm:g})", remedy)
    pitch = options.taken("pixel_size_mm", pitch_mm)
    return ConeGeometry(axis_mm, detector_mm, panel, pitch, options.detector_offset_mm or offset_mm)


@dataclass(frozen=True, eq=False)
class RotaryStage:
    """A source and a panel of ``geometry`` at rest, and a sample that turns about an axis, which may be off the central ray.

    axis_u_mm: how far the axis lies to the right of the central ray, seen from the source. roll_rad, tilt_rad: how far the
    axis' top leans to the right, and towards the panel. shift_mm (F, 2): the panel's shifts (v, u) per frame."""

    geometry: Geometry
    axis_u_mm: float = 0.0
    roll_rad: float = 0.0
    tilt_rad: float = 0.0
    shift_mm: np.ndarray | None = None

    def poses(self, angle_rad: np.ndarray, shift_mm: np.ndarray | float = 0.0) -> np.ndarray:
        """Returns poses (T, 12), see ``PoseTable``, in the sample's frame at gantry angles (T,) in rad. shift_mm (T, 2): the
        panel's shifts (v, u)."""
        upright = self.geometry.pose(0.0).reshape(4, 3)  # axes: x towards the source, y to the right, z up
        is_parallel = isinstance(self.geometry, ParallelGeometry)
        parts = np.repeat(upright[None], len(angle_rad), axis=0)
        parts[:, int(is_parallel) : 2, 1] -= self.axis_u_mm  # moves source and panel, so that the axis is at y = 0
        parts[:, 1, 2:0:-1] += shift_mm
        leaning = Rotation.from_euler("YX", [-self.tilt_rad, -self.roll_rad])  # rotates the z axis onto the stage's axis
        turned = (Rotation.from_euler("z", np.reshape(angle_rad, (-1, 1))) * leaning.inv()).as_matrix()
        return np.asarray(np.einsum("tij,tkj->tki", turned, parts).reshape(-1, 12))

    def turned(
        self, angle_rad: np.ndarray, timing: Timing, subject: str
    ) -> tuple[CircularOrbit | PoseTable, Geometry]:
        """Returns trajectory and nearest circular geometry for gantry angles (F,) in rad. The trajectory is a circular orbit
        if the axis crosses the central ray at a right angle and the panel has no shifts, else a pose table."""
        question_unit(angle_rad, f"{subject} angles", "deg")
        if self.axis_u_mm == self.roll_rad == self.tilt_rad == 0 and self.shift_mm is None:
            return turning(self.geometry, angle_rad, timing), self.geometry
        turned_rad = unwrapped(angle_rad)
        shift_mm = np.zeros((len(turned_rad), 2)) if self.shift_mm is None else self.shift_mm

        def poses(position: np.ndarray) -> np.ndarray:
            return self.poses(along(turned_rad, position), along(shift_mm, position))

        is_parallel = isinstance(self.geometry, ParallelGeometry)
        return table_over_time(poses, timing, subject, self.geometry.detector_shape, is_parallel)


def scan_on_stage(
    stage: RotaryStage, options: ImportOptions, path: Path, title: str, frames: np.ndarray, sides: tuple[str, str],
    angle_rad: np.ndarray, places: np.ndarray, names: dict[str, str], said: str, *, stored: StoredTiming | None = None,
    flats: np.ndarray | None = None, darks: np.ndarray | None = None, flat_value: float | None = None,
    light: np.ndarray | None = None,
) -> Scan:
    """Returns the scan of a sample on a stage. frames (F, v, u) are counts, which the file ``path`` describes. Options
    replace values of the file.

    - sides: where row 0 and column 0 are, such as ("top", "left"). angle_rad (F,): gantry angles. places (F,): the frames'
      numbers from 0 on. names, said: see ``assemble_scan``. stored: the file's timing.
    - flats, darks (n, v, u): None where the scanner has applied them. flat_value: counts of air that the file states.
    - light (F,): that of counts, in units of the flats'; None: as bright."""
    timing = make_timing(str(path), places, options, stored)
    trajectory, geometry = stage.turned(angle_rad, timing, str(path))
    images = (None if one is None else oriented(one, options, *sides) for one in (frames, flats, darks))
    frames, flats, darks = images  # type: ignore[assignment]
    with_air = replace(options, flat_value=options.flat_value or flat_value)
    integrals = line_integrals(
        str(path), frames, with_air, flats=flats, darks=darks, convention="counts", is_corrected=darks is None
    )
    if light is not None and options.quantity in (None, "counts"):
        integrals = integrals.in_light(light)
    parts = integrals, trajectory, geometry, timing, options, path
    return assemble_scan(*parts, title=title, names=names, said=said)


def along(values: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Interpolates values (F, ...) linearly at frame positions (T,), and extrapolates beyond the ends: (T, ...)."""
    if len(values) == 1:
        return np.repeat(values, len(position), axis=0)
    left = np.clip(np.floor(position).astype(int), 0, len(values) - 2)
    part = (position - left).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(values[left] + part * (values[left + 1] - values[left]))
