"""Do exposure, readout and the frames' times fit each other and the angles?"""

import math

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, EncoderTable, FrameSweeps, PoseTable, Scan
from phyradgs_cl.check.finding import OK, SUSPICIOUS, Finding

_SLACK = 1e-3  # relative: times and angles are stored rounded
_APART = 0.02  # relative: beyond what a gantry's speed varies without an encoder's word
_TABLE = 100.0  # times the frames' time: so much longer is no table of one scan, where the frames also see
_FEW_RAD = math.radians(5)  # less than this of its path
_MILLI = (900.0, 3000.0)  # times as long: a table in ms beside frames in s, with some of it before and after them
_QUESTION = "timing"


def check_timing(scan: Scan) -> Finding:
    """A line cannot open while it is open, nor a frame be read while the last one is, nor a gantry be at two angles.
    The number is the worst of: exposure and readout over the shortest time between frames (at most 1), one more
    than how far the angles between frames are from those that the speed within the frames gives, and how many times as long
    as the frames a table of angles or poses is of which they see next to nothing."""
    starts_s = np.asarray(scan.frame_start_s, np.float64)
    if scan.frames < 2:
        return Finding(_QUESTION, OK, 0.0, 1.0, "share", "one frame: nothing to compare")
    period_s = float(np.diff(starts_s).min())
    if period_s <= 0:
        advice = "correct frame_start_time; frames must follow each other"
        text = "frames that start before their predecessors"
        return Finding(_QUESTION, SUSPICIOUS, period_s, 0.0, "s", text, advice)
    if not scan.is_fly:
        return Finding(_QUESTION, OK, 0.0, 1.0, "share", "the gantry stands while it exposes: any timing fits")
    found = [
        _share("exposure", "a line would open again while it is open", scan.shutter.exposure_s / period_s),
        _share("readout", "a frame would be read while the last one is", scan.shutter.readout_s / period_s),
    ]
    if isinstance(scan.trajectory, CircularOrbit) and isinstance(scan.trajectory.kinematics, FrameSweeps):
        found.append(_speed(scan, starts_s))  # tables say the same within frames and between them
    found += _table(scan)
    wrong = [f for f in found if f.verdict == SUSPICIOUS]
    return wrong[0] if wrong else max(found, key=lambda f: f.value / f.threshold)


def exposure_arc_rad(scan: Scan) -> float:
    """Angle by which the gantry turns while a line is open, of the frame in the middle; 0 where it stands."""
    if not scan.is_fly:
        return 0.0
    frame = scan.frames // 2
    start_s = float(scan.frame_start_s[frame])
    ends = azimuth_rad(scan.trajectory.pose(frame, np.array([start_s, start_s + scan.shutter.exposure_s])))
    return abs(float(wrapped(ends[1:] - ends[:1])[0]))


def start_azimuths_rad(scan: Scan) -> np.ndarray:
    """Angles (F,) about +z at which the source stands as each frame starts."""
    starts = [scan.trajectory.pose(f, scan.frame_start_s[f : f + 1]) for f in range(scan.frames)]
    return azimuth_rad(np.concatenate(starts))


def azimuth_rad(pose: np.ndarray) -> np.ndarray:
    """Angles (...) about +z at which poses (..., 12) have their source, in (-π, π]."""
    return np.arctan2(pose[..., 1], pose[..., 0])


def _share(name: str, meaning: str, share: float) -> Finding:
    if share <= 1 + _SLACK:
        text = f"{name} takes {100 * share:.3g} % of the time between frames"
        return Finding(_QUESTION, OK, share, 1.0, "share", text)
    advice = f"correct the {name} time (is it stated {share:.3g} times too long?) or frame_start_time"
    text = f"{name} takes {100 * share:.4g} % of the time between frames: {meaning}"
    return Finding(_QUESTION, SUSPICIOUS, share, 1.0, "share", text, advice)


def _table(scan: Scan) -> list[Finding]:
    """What is wrong with the unit of a table's times, or of the frames': nothing where the frames see some of its path."""
    path = scan.trajectory.kinematics if isinstance(scan.trajectory, CircularOrbit) else scan.trajectory
    if not isinstance(path, EncoderTable | PoseTable):
        return []
    longer = float(np.ptp(path.time_s)) / (float(np.ptp(scan.frame_start_s)) + scan.shutter.span_s)
    seen_rad = float(np.ptp(np.unwrap(start_azimuths_rad(scan))))
    if longer <= _TABLE or seen_rad >= _FEW_RAD:
        return []
    kind, seen_deg = "poses" if isinstance(path, PoseTable) else "angles", math.degrees(seen_rad)
    text = f"the table of {kind} runs {longer:.4g} times as long as the frames, which see {seen_deg:.3g}° of it"
    is_milli = _MILLI[0] <= longer <= _MILLI[1]
    advice = "are its times in ms, beside frames in s?" if is_milli else "correct its times or the frames', and their units"
    return [Finding(_QUESTION, SUSPICIOUS, longer, _TABLE, "share", text, advice)]


def _speed(scan: Scan, starts_s: np.ndarray) -> Finding:
    """Compares the angle to the next frame with the speed in this frame; as a median, since gantries are not clocks."""
    span_s = scan.shutter.exposure_s or scan.shutter.span_s
    moved, stepped = np.empty(scan.frames - 1), np.empty(scan.frames - 1)
    for frame in range(scan.frames - 1):
        times_s = starts_s[frame] + np.array([0.0, span_s])
        first, last = azimuth_rad(scan.trajectory.pose(frame, times_s))
        following = azimuth_rad(scan.trajectory.pose(frame + 1, starts_s[frame + 1 : frame + 2]))[0]
        moved[frame] = wrapped(last - first) * (starts_s[frame + 1] - starts_s[frame]) / span_s
        stepped[frame] = moved[frame] + wrapped(following - first - moved[frame])
    apart = float(np.median(np.abs(stepped - moved))) / max(float(np.median(np.abs(stepped))), 1e-9)
    text = f"the angles between frames are {100 * apart:.2f} % from those that the speed in the frames gives"
    if apart <= _APART:
        return Finding(_QUESTION, OK, 1 + apart, 1 + _APART, "share", text)
    degrees = math.degrees(float(np.median(moved))), math.degrees(float(np.median(stepped)))
    advice = (
        f"the gantry would turn {degrees[0]:.4g}° from frame to frame, the angles say {degrees[1]:.4g}°: correct the "
        "exposure time, frame_start_time or rotation_angle_end"
    )
    return Finding(_QUESTION, SUSPICIOUS, 1 + apart, 1 + _APART, "share", text, advice)


def wrapped(angle: np.ndarray | float) -> np.ndarray:
    """Angles (...) in radians, in [-π, π)."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi
