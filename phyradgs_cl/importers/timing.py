"""From a list of angles, and what is known about time, to shutter, trajectory and opening times."""

import logging
from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, FrameSweeps, Shutter
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.options import ImportOptions

_log = logging.getLogger(__name__)
_OF_A_TURN = ("exposure_s", "readout_s", "angle_at", "readout_axis", "readout_direction")


@dataclass(frozen=True, eq=False)
class Timing:
    """When frames were taken. ``start_s`` (F,) opening of each first-read line; ``is_fly``: the gantry never stops;
    ``angle_at``: a stored angle belongs to the "start" or "middle" of the first line's exposure. ``assumed``: what neither
    file nor user stated, in the words of ``acquisition/plausible.py``."""

    shutter: Shutter
    start_s: np.ndarray
    is_fly: bool
    angle_at: str = "start"
    assumed: tuple[str, ...] = ()

    @property
    def angle_time_s(self) -> np.ndarray:
        """(F,): the moments that the stored angles belong to."""
        return self.start_s + (self.shutter.exposure_s / 2 if self.angle_at == "middle" else 0.0)


@dataclass(frozen=True, eq=False)
class StoredTiming:
    """What a format itself says; None where it is silent. ``start_s`` (F,): the gantry did not stop. ``written``: by
    what names a description that the user wrote says any of it; a file's header does not count."""

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
    subject: str, frames: int, options: ImportOptions, stored: StoredTiming | None = None
) -> Timing:
    """Timing of ``frames`` frames; the options win over what is stored. Start times, or the time from frame to frame,
    say that the gantry turned all the while, which needs an exposure. Without them every frame is taken at rest, and
    what a user says of a turn in between is refused."""
    stored = stored or StoredTiming()
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
        checks.shape(f"{subject} start times", start_s, (frames,))
    elif frame_time_s is not None:
        start_s = np.arange(frames) * frame_time_s
    else:
        _check_rest(subject, shutter, options, stored)
        return Timing(shutter, np.arange(frames) * max(shutter.span_s, 1.0), False, angle_at)
    _check_flight(subject, shutter, start_s, options)
    return Timing(shutter, start_s, True, angle_at, assumed)


def turning(geometry: ConeGeometry, angle_rad: np.ndarray, timing: Timing) -> CircularOrbit:
    """A circular orbit through gantry angles (F,), each frame at the slope of the angles over time around it (one-sided
    at both ends); at rest where the gantry stands."""
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
    """Refuses what a user says of a turn without the time from frame to frame; warns where a file has an exposure."""
    asked = [options.called(name) for name in options.given(_OF_A_TURN)]
    frame_time = f"{options.named('frame_time_s')} or {options.named('fps')}"
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
