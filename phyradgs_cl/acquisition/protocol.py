"""Scan protocols for simulations: number of frames, turns, arc of an exposure, readout and pulse."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.acquisition.readout import Named
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.trajectory import CircularOrbit, EncoderTable, FrameSweeps
from phyradgs_cl.errors import InputError
from phyradgs_cl.text import flag_of

_PULSE = "When the beam is on, in exposures after a frame's start."
_FEWEST_TURNS = 1e-3  # least number of turns of a scan, counterclockwise or clockwise
_MOST_TURNS = 10_000


@dataclass(frozen=True)
class Protocol:
    """A scan of ``views`` frames in ``turns`` turns at constant speed. In the exposure of a line, the gantry turns by
    ``exposure_deg`` (paper, section 3.1).

    A negative ``turns`` means clockwise, seen from above. start_deg: the gantry's angle as the first frame begins.
    exposure_s: the exposure T_exp of a line. readout_ratio: (readout time) / T_exp. is_fly: False if the gantry stops
    for every frame. pulse: (start, length) of the time in which the beam is on, after a frame's start, in units of T_exp;
    None means always. Raises InputError for values out of range."""

    views: int = checks.option(25, "Frames of the scan.", "protocol's", range=(1, 100_000))
    exposure_deg: float = checks.option(14.4, "Arc of one exposure, degrees.", "protocol's", range=(0, 360))
    readout_ratio: float = checks.ranged(0.86, 0, 1000)
    start_deg: float = checks.option(0.0, "Gantry angle at the start, degrees.", "0", range=(-1e6, 1e6))
    exposure_s: float = 1.0
    is_fly: bool = True
    pulse: tuple[float, float] | None = checks.option(None, _PULSE, "scanner's: always on")
    turns: float = checks.option(1.0, "Turns over which the frames are spread; below 0 clockwise.", "1")

    def __post_init__(self) -> None:
        checks.fields_within(flag_of, self)
        object.__setattr__(self, "views", int(self.views))
        if not (checks.is_number(self.turns) and _FEWEST_TURNS <= abs(self.turns) <= _MOST_TURNS):
            expected = f"a number from {_FEWEST_TURNS} to {_MOST_TURNS}, negative for a clockwise gantry"
            raise InputError("--turns", checks.short_repr(self.turns), expected)
        if self.pulse is not None:
            self._check_pulse(*checks.numbers("--pulse", self.pulse, (2,)))

    def _check_pulse(self, start: float, length: float) -> None:
        last = 1 + self.readout_ratio
        fits = np.isfinite(start) and np.isfinite(length) and start < last and start + length > 0
        if not (fits and length > 0):
            expected = f"a start and a length above 0, in exposures, that meet a frame's window (0 to {last:g})"
            raise InputError("--pulse", f"{start:g},{length:g}", expected, "write for example 0.86,0.14")

    @property
    def step_deg(self) -> float:
        return 360.0 * self.turns / self.views

    def at_rate(self, fps: float, readout_ms: float | None = None, named: Named = str) -> "Protocol":
        """Returns the protocol with the exposure time that gives ``fps`` frames per second. readout_ms: the readout in ms;
        None keeps its ratio to the exposure.

        Raises InputError for a rate not above 0, an arc of 0, and a readout longer than a frame. named: translates the names
        of arguments in messages."""
        checks.positive(named("fps"), fps)
        if self.exposure_deg == 0:
            raise InputError(named("fps"), f"{fps:g} with an exposure arc of 0°", "a gantry that turns", "leave fps out")
        exposure_s = self.exposure_deg / (abs(self.step_deg) * fps)
        if readout_ms is None:
            return replace(self, exposure_s=exposure_s)
        if readout_ms > 1000 / fps:
            expected = f"at most the {1000 / fps:.4g} ms of a frame at {fps:g} fps"
            raise InputError(named("readout_ms"), f"{readout_ms:g}", expected, "correct its unit, or the frame rate")
        return replace(self, exposure_s=exposure_s, readout_ratio=readout_ms / 1000 / exposure_s)

    def shutter(self, axis: str = "rows", direction: int = 1) -> Shutter:
        start, length = self.pulse or (0.0, 0.0)
        pulse_s = (start * self.exposure_s, length * self.exposure_s) if self.pulse else None
        return Shutter(self.exposure_s, self.readout_ratio * self.exposure_s, axis, direction, pulse_s)

    def frame_start_s(self) -> np.ndarray:
        """Returns when the frames open, (F,) in s. From one frame to the next the gantry turns by ``step_deg``. With an arc
        of 0, each frame opens as the frame before it closes."""
        if self.exposure_deg == 0:
            return np.arange(self.views) * self.shutter().span_s
        return np.arange(self.views) * abs(self.step_deg) / self.exposure_deg * self.exposure_s

    def window_s(self) -> tuple[float, float]:
        """Returns when the scan's first line opens and its last line closes, in s."""
        start_s = self.frame_start_s()
        return float(start_s[0]), float(start_s[-1]) + self.shutter().span_s

    def angle_start_rad(self) -> np.ndarray:
        return np.asarray(np.deg2rad(self.start_deg + np.arange(self.views) * self.step_deg))

    def orbit(
        self, geometry: Geometry, jitter_deg: float = 0.0, rng: np.random.Generator | None = None
    ) -> CircularOrbit:
        """Returns the trajectory. A stop-and-shoot gantry rests where the same fly-scan would be in the middle of a frame.

        jitter_deg: the standard deviation of ``views`` + 1 random angles at even times, linear in between. They are added to
        a fly-scan's angles, and the encoder records them. Raises InputError for jitter without an arc or without ``rng``."""
        first = self.angle_start_rad()
        arc_rad = self._arc_rad
        if not self.is_fly:
            middle = first + arc_rad * self.shutter().middle_s / self.exposure_s
            return CircularOrbit(geometry, FrameSweeps(self.frame_start_s(), self.exposure_s, middle, middle))
        if jitter_deg > 0:
            if self.exposure_deg == 0:
                raise InputError("jitter", "an exposure arc of 0°", "a gantry that turns", "leave jitter out")
            if rng is None:
                raise InputError("jitter", "no random generator", "a seeded generator")
            return CircularOrbit(geometry, self._wandering_encoder(np.deg2rad(jitter_deg), rng))
        sweeps = FrameSweeps(self.frame_start_s(), self.exposure_s, first, first + arc_rad)
        return CircularOrbit(geometry, sweeps)

    @property
    def _arc_rad(self) -> float:
        return float(np.copysign(np.deg2rad(self.exposure_deg), self.turns))

    def _wandering_encoder(self, jitter_rad: float, rng: np.random.Generator) -> EncoderTable:
        end_s = self.window_s()[1]
        speed_rad_per_s = self._arc_rad / self.exposure_s
        knot_s = np.linspace(0.0, end_s, self.views + 1)
        time_s = np.linspace(0.0, end_s, 16 * self.views + 1)
        wander = np.interp(time_s, knot_s, rng.normal(0, jitter_rad, knot_s.size))
        return EncoderTable(time_s, np.deg2rad(self.start_deg) + speed_rad_per_s * time_s + wander)


PROTOCOLS = {
    "rapid": Protocol(views=25, exposure_deg=14.4),
    "standard": Protocol(views=50, exposure_deg=7.2),
    "static": Protocol(views=25, exposure_deg=14.4, is_fly=False),
}


def make_protocol(name: str, **changes: Any) -> Protocol:
    """Returns the protocol ``name`` with ``changes`` to its fields; a change to None is ignored. Raises InputError for an
    unknown name, and for values out of range."""
    if name not in PROTOCOLS:
        raise InputError("protocol", repr(name), f"one of {', '.join(PROTOCOLS)}")
    return replace(PROTOCOLS[name], **{k: v for k, v in changes.items() if v is not None})
