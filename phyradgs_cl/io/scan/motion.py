"""Reads and writes motion in a scan file: the scanner's as poses, encoder table or angles, the object's as gating signal."""

import logging
import math
from dataclasses import replace

import h5py
import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, EncoderTable, FrameSweeps, PoseTable, Scan, SpeedRamp
from phyradgs_cl.acquisition.geometry import Geometry, ParallelGeometry, towards_source
from phyradgs_cl.acquisition.trajectory import ConstantSpeed, Trajectory, is_parallel
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gating
from phyradgs_cl.io import scan as schema
from phyradgs_cl.io.hdf5 import Hdf5Source
from phyradgs_cl.io.hdf5 import datasets as h5

_log = logging.getLogger(__name__)
_KINEMATICS = (ConstantSpeed, SpeedRamp, EncoderTable, FrameSweeps)  # motions of a circular orbit that files can hold
_RAMP_ERROR_RAD = 1e-9  # a speed ramp is stored as a table of angles, whose interpolation errs by at most this
_MOST_RAMP_SAMPLES = 500_000  # most rows of a speed ramp's table, about 8 MB; a longer ramp is stored less exactly
_SUSPECT_RAD = math.radians(5.0)  # encoder table and rotation_angle differ by more only if one has a wrong sign or zero
_GAP = 1e-9  # half of the time between a pose table's frames, as a fraction of an exposure
_LEAST_SPAN_S = 1e-6  # least time that ``sampled`` covers in a frame: a table needs two times, even without any duration
_MOST_SAMPLES = 1024  # ``sampled`` raises an error if a table of more samples per frame still misses the trajectory
_AS_TABLE = "give it as a PoseTable"


def has_motion(source: Hdf5Source, entry: str) -> bool:
    """Returns whether the file says how the gantry moves within exposures: by end angles, an encoder or a pose table."""
    end = source.optional(f"{entry}/{schema.SAMPLE}/rotation_angle_end")
    groups = (schema.KINEMATICS, schema.POSES)
    found = [source.optional_group(f"{entry}/{group}") for group in groups]
    return end is not None or any(group is not None for group in found)


def read_trajectory(
    source: Hdf5Source, entry: str, geometry: Geometry, used: np.ndarray, start_s: np.ndarray,
    exposure_s: float,
) -> CircularOrbit | PoseTable:
    """Reads the trajectory. used, bool (F,): which stored frames are projections. start_s (P,): when the P projections
    begin. Raises InputError for damage, and for tables whose times do not increase."""
    first_rad = read_angles(source, entry, "rotation_angle", used)
    poses, kinematics = f"{entry}/{schema.POSES}", f"{entry}/{schema.KINEMATICS}"
    if source.optional_group(poses) is not None:
        time_s = _read_table_times(source, f"{poses}/time_s")
        table_mm = h5.read_array(source, f"{poses}/pose", (len(time_s), 12), h5.LENGTH)
        return PoseTable(time_s, table_mm, source.name(f"{poses}/pose"), isinstance(geometry, ParallelGeometry))
    if source.optional_group(kinematics) is not None:
        time_s = _read_table_times(source, f"{kinematics}/time_s")
        address = f"{kinematics}/angle_deg"
        angle_rad = h5.read_array(source, address, (len(time_s),), h5.ANGLE)
        angle_rad = angle_rad * _sense(source, address, absent=1.0)
        apart_rad = np.interp(start_s, time_s, angle_rad) - first_rad
        apart_rad = np.abs((apart_rad + np.pi) % (2 * np.pi) - np.pi)
        if apart_rad.max() > _SUSPECT_RAD:
            text = "%s: up to %.3g° from rotation_angle; the table is used"
            _log.warning(text, source.name(address), math.degrees(apart_rad.max()))
        return CircularOrbit(geometry, EncoderTable(time_s, angle_rad, source.name(f"{kinematics}/time_s")))
    last_rad = first_rad
    if exposure_s > 0 and source.find(f"{entry}/{schema.SAMPLE}/rotation_angle_end") is not None:
        last_rad = read_angles(source, entry, "rotation_angle_end", used)
    return CircularOrbit(geometry, FrameSweeps(start_s, exposure_s, first_rad, last_rad))


def read_angles(source: Hdf5Source, entry: str, name: str, used: np.ndarray) -> np.ndarray:
    """Reads gantry angles (P,) in rad of frames in ``used``, bool (F,). name: rotation_angle or rotation_angle_end."""
    address = f"{entry}/{schema.SAMPLE}/{name}"
    angle_rad = h5.read_array(source, address, used.shape, h5.ANGLE)[used]
    # Without @rotates, an end angle is of the gantry or of the sample as the start angle is.
    start = f"{entry}/{schema.SAMPLE}/rotation_angle"
    return angle_rad * _sense(source, address, absent=_sense(source, start, absent=-1.0))


def storable(scan: Scan) -> Scan:
    """Returns the scan with a trajectory that files can hold. A user-defined trajectory, or a circular orbit with
    user-defined kinematics, becomes a pose table that is exact to a ten-thousandth of a pixel. Where poses jump between
    frames that touch in time, exposures become shorter by two billionths. Raises InputError if no table is so exact."""
    path, start_s = scan.trajectory, scan.frame_start_s
    if isinstance(path, PoseTable) or (isinstance(path, CircularOrbit) and isinstance(path.kinematics, _KINEMATICS)):
        return scan
    error_mm = 1e-4 * min(scan.geometry.pixel_size_mm)
    if not scan.is_fly:  # a frame at rest has one pose, in its middle
        middle_s = scan.middle_times_s - _LEAST_SPAN_S / 2
        return replace(scan, trajectory=sampled(path, middle_s, 0.0, error_mm))
    if _jumps(scan, error_mm):
        shorter_s = scan.shutter.exposure_s - 2 * _gap_s(scan)
        scan = replace(scan, shutter=replace(scan.shutter, exposure_s=shorter_s))
    return replace(scan, trajectory=sampled(path, start_s, scan.shutter.span_s, error_mm))


def overlaps(scan: Scan) -> bool:
    """Returns whether frames of a scan overlap in time. A frame that begins when another ends does not overlap it."""
    return bool(np.diff(np.sort(scan.frame_start_s)).min(initial=np.inf) < scan.shutter.span_s - _gap_s(scan))


def _gap_s(scan: Scan) -> float:
    """Returns half of the time in s that ``storable`` puts between frames: a billionth of an exposure, but at least 16
    roundings of the scan's latest time in float64."""
    latest_s = float(np.abs(scan.frame_start_s).max()) + scan.shutter.span_s
    return max(_GAP * scan.shutter.exposure_s, 16 * float(np.spacing(latest_s)))


def _jumps(scan: Scan, error_mm: float) -> bool:
    """Returns whether a pose jumps by more than ``error_mm`` where a frame ends and the next begins, as after
    ``move_views``. A pose table cannot express such a jump."""
    order, path = np.argsort(scan.frame_start_s, kind="stable"), scan.trajectory
    first_s = scan.frame_start_s[order]
    touches = np.abs(np.diff(first_s) - scan.shutter.span_s) <= _gap_s(scan)
    for k in np.flatnonzero(touches):
        before = path.pose(int(order[k]), first_s[k : k + 1] + scan.shutter.span_s)
        after = path.pose(int(order[k + 1]), first_s[k + 1 : k + 2])
        if np.abs(after - before).max() > error_mm:
            return True
    return False


def sampled(trajectory: Trajectory, frame_start_s: np.ndarray, span_s: float, error_mm: float) -> PoseTable:
    """Samples a user-defined trajectory into a pose table, over ``span_s`` from each frame's start (F,). The table's poses
    differ from the trajectory's by at most ``error_mm``.

    Raises InputError if even a fine table is not close enough, as for frames that overlap in time with different poses."""
    samples = 2
    while True:
        offsets_s = np.linspace(0.0, max(span_s, _LEAST_SPAN_S), samples)
        times = np.asarray(frame_start_s, np.float64)[:, None] + offsets_s
        poses = np.concatenate([trajectory.pose(f, t) for f, t in enumerate(times)])
        time_s, at = np.unique(times.ravel(), return_index=True)  # unique, because frames may overlap in time
        table = PoseTable(time_s, poses[at], "trajectory", is_parallel(trajectory))
        between = (time_s[:-1] + time_s[1:]) / 2  # the table is tested between all samples, since frames may overlap
        inside = [between[(t[0] < between) & (between < t[-1])] for t in times]
        errors = (np.abs(table.pose(f, t) - trajectory.pose(f, t)).max(initial=0.0) for f, t in enumerate(inside))
        worst_mm = max(errors)
        if worst_mm <= error_mm:
            return table
        if samples > _MOST_SAMPLES:
            found = f"poses that {samples} samples per frame miss by {worst_mm:.3g} mm"
            overlap = np.any(np.sort(times[:, 0])[1:] < np.sort(times[:, -1])[:-1])
            remedy = "take frames that do not overlap in time: a file has one pose at a time" if overlap else _AS_TABLE
            raise InputError("trajectory", found, f"at most {error_mm:.3g} mm", remedy)
        samples = 2 * samples - 1


def write_motion(entry: h5py.Group, scan: Scan, frame_of: np.ndarray) -> None:
    """Writes tables, and gantry angles at start and end of the exposure of each frame's first line; for a gantry at rest its
    angle in the middle of the frame. frame_of (F,): the projection whose angles each stored frame gets."""
    sample, shutter = entry[schema.SAMPLE], scan.shutter
    offsets_s = np.array([0.0, shutter.exposure_s] if scan.is_fly else [shutter.middle_s] * 2)
    first_rad, last_rad = np.array([_angles(scan, f, at_s + offsets_s) for f, at_s in enumerate(scan.frame_start_s)]).T
    h5.write_number(sample, "rotation_angle", np.rad2deg(first_rad)[frame_of], "degree", rotates="gantry")
    if scan.is_fly and shutter.exposure_s > 0:
        h5.write_number(sample, "rotation_angle_end", np.rad2deg(last_rad)[frame_of], "degree", rotates="gantry")
    path = scan.trajectory
    if isinstance(path, PoseTable):
        write_poses(entry, scan)
    elif scan.is_fly and isinstance(path, CircularOrbit) and isinstance(path.kinematics, EncoderTable | SpeedRamp):
        time_s, angle_rad = _angle_table(scan, path.kinematics)
        group = _table_group(entry, "kinematics", time_s)
        h5.write_number(group, "angle_deg", np.rad2deg(angle_rad), "degree", rotates="gantry")


def write_poses(entry: h5py.Group, scan: Scan) -> None:
    path = scan.trajectory
    assert isinstance(path, PoseTable)
    # a stop-and-shoot scan is stored without exposure; its poses then belong to the starts of frames, not their middles
    time_s = path.time_s - (0.0 if scan.is_fly else scan.shutter.middle_s)
    h5.write_number(_table_group(entry, "poses", time_s), "pose", path.table, "mm")


def _table_group(entry: h5py.Group, name: str, time_s: np.ndarray) -> h5py.Group:
    group = h5.new_group(entry[schema.EXTRA], name, "NXcollection")
    h5.write_number(group, "time_s", time_s, "s")
    return group


def _angles(scan: Scan, frame: int, time_s: np.ndarray) -> np.ndarray:
    if isinstance(scan.trajectory, CircularOrbit):
        return scan.trajectory.angle_rad(frame, time_s)
    source = towards_source(scan.trajectory.pose(frame, time_s), scan.is_parallel)  # the source's azimuth is the angle
    return np.unwrap(np.arctan2(source[:, 1], source[:, 0]))


def _angle_table(scan: Scan, kinematics: EncoderTable | SpeedRamp) -> tuple[np.ndarray, np.ndarray]:
    """Returns times (T,) in s and angles (T,) in rad: the encoder's, or samples of a speed ramp. The samples are dense
    enough for linear interpolation to err by at most 1e-9 rad, but at most 500,000."""
    if isinstance(kinematics, EncoderTable):
        return kinematics.time_s, kinematics.angle_rad_table
    first_s, last_s = float(np.min(scan.frame_start_s)), float(np.max(scan.frame_start_s)) + scan.shutter.span_s
    step_s = math.sqrt(8 * _RAMP_ERROR_RAD / max(abs(kinematics.acceleration_rad_per_s2), 1e-12))
    samples = min(_MOST_RAMP_SAMPLES, max(2, math.ceil((last_s - first_s) / step_s) + 1))
    time_s = np.linspace(first_s, last_s, samples)
    return time_s, kinematics.angle_rad(0, time_s)


def _read_table_times(source: Hdf5Source, address: str) -> np.ndarray:
    time_s = h5.read_array(source, address, (None,), h5.TIME)
    if len(time_s) < 2:
        raise source.error(address, f"{len(time_s)} samples", "at least 2")
    if np.any(np.diff(time_s) <= 0):
        found = f"times that do not increase at index {int(np.argmax(np.diff(time_s) <= 0)) + 1}"
        raise source.error(address, found, "strictly increasing times", "sort the table by time")
    return time_s


def _sense(source: Hdf5Source, address: str, absent: float) -> float:
    """Returns the factor that turns a stored angle into the gantry's: +1 if @rotates is gantry, −1 if sample. ``absent`` is
    returned if the attribute is missing."""
    rotates = h5.read_attribute(source, address, "rotates")
    if rotates is None:
        return absent
    if rotates not in schema.ROTATES:
        raise InputError(f"{source.name(address)} @rotates", repr(rotates), "'gantry' or 'sample'")
    return 1.0 if rotates == "gantry" else -1.0


def read_gating(source: Hdf5Source, entry: str, used: np.ndarray, middle_s: np.ndarray) -> Gating | None:
    """Reads the gating signal or phase; None if the file has neither. Without times of their own, the values belong to the
    middles of the frames. used, bool (F,): which stored frames are projections. middle_s (P,): the middle of each
    projection's time. Raises InputError for a signal and a phase together, and for equal times."""
    if source.optional_group(f"{entry}/{schema.GATING}") is None:
        return None
    signal, phase, times = (f"{entry}/{name}" for name in (schema.SIGNAL, schema.PHASE, schema.GATING_TIMES))
    is_phase, has_times = (source.optional(address) is not None for address in (phase, times))
    if is_phase and source.optional(signal) is not None:
        raise source.error(signal, "a signal beside a phase", "one of the two", "remove one of them")
    address = phase if is_phase else signal
    times_s = h5.read_array(source, times, (None,), h5.TIME) if has_times else middle_s
    values = h5.read_array(source, address, times_s.shape if has_times else used.shape, h5.PHASE if is_phase else None)
    order = np.arange(len(times_s)) if has_times else np.argsort(middle_s, kind="stable")
    try:
        return Gating(times_s[order], values[order] if has_times else values[used][order], is_phase)
    except InputError as error:
        found = f"{error.subject}: {error.found}"
        if has_times:
            raise source.error(times, found, "times that rise", "sort the samples by time") from error
        raise source.error(address, found, "frames at different times", "correct frame_start_time") from error


def write_gating(extra: h5py.Group, scan: Scan, frame_of: np.ndarray) -> None:
    """Writes the signal, or the phase in cycles: a value for each stored frame if they belong to the middles of the frames,
    else all samples and their times. frame_of (F,): the projection whose value each stored frame gets."""
    gating = scan.gating
    if gating is None:
        return
    # poses at rest are stored without exposure: the start of a frame then stands for its middle, as in ``write_poses``
    rests = not scan.is_fly and isinstance(scan.trajectory, PoseTable)
    times_s = gating.times_s - (scan.shutter.middle_s if rests else 0.0)
    middle_s = scan.frame_start_s + (0.0 if rests else scan.shutter.span_s / 2)
    group, values = h5.new_group(extra, "gating", "NXcollection"), gating.values
    if np.array_equal(times_s, np.sort(middle_s)):
        values = values[np.searchsorted(times_s, middle_s)][frame_of]
    else:
        h5.write_number(group, "time_s", times_s, "s")
    h5.write_number(group, "phase" if gating.is_phase else "signal", values, "cycle" if gating.is_phase else None)
