"""What can be asked for by name: how it is stated, in which unit, and what it looks like when nothing tells it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.moved import Change
from phyradgs_cl.check.questions.timing import exposure_arc_rad
from phyradgs_cl.errors import InputError
from phyradgs_cl.text import near_miss

_STEP_PX = 0.25  # how far a derivative's differences move the image at its edge
_TIMING_STEP, _LEAST_TIME = 0.1, 0.7  # of the time that is stated: of a difference, and what may be taken off
_PER_ONE = 50.0  # what moves nothing is tried by half a percent, and stepped by four at most
_MOST_TILT_RAD = math.radians(2.0)
_SMALL_MISMATCH = 1.3  # of signals that are the other way half a turn later, which errors of voxels are not
_LEAST_KNOWN_RAD = math.radians(10.0)  # standard deviation of an angle that says nothing: sines are straight no further


@dataclass(frozen=True)
class Parameter:
    """A field of ``Change``. ``scale``: of the unit that people read per unit of the field. ``alike``: what the object does
    instead, where the frames cannot tell. ``pixels``: by how many pixels a unit of the field moves the image at its edge.
    ``mismatch``: errors that were measured (docs/calibrate.md) over what noise alone would do: voxels are no object."""

    name: str
    field: str
    unit: str
    alike: str
    stated: Callable[[Scan], float]
    pixels: Callable[[Scan], float]
    scale: float = 1.0
    is_timing: bool = False
    mismatch: float = 2.0

    def step(self, scan: Scan) -> float:
        """Half the distance of a central difference, in the field's unit."""
        step = _STEP_PX / self.pixels(scan)
        if self.unit == "deg":
            return min(step, _MOST_TILT_RAD)
        return min(step, _TIMING_STEP * self.stated(scan) or step) if self.is_timing else step

    def is_told(self, deviation: float) -> bool:
        """Whether a value with this standard deviation, in the field's unit, says anything: an angle may be all round."""
        return self.unit != "deg" or deviation < _LEAST_KNOWN_RAD

    def lowest(self, scan: Scan) -> float:
        """The lowest value of the field that is tried: times stay above 0."""
        stated = self.stated(scan) if self.is_timing else 0.0
        return -_LEAST_TIME * stated if stated > 0 else -math.inf


def _half_mm(scan: Scan, axis: int) -> float:
    return scan.geometry.detector_shape[axis] * scan.geometry.pixel_size_mm[axis] / 2


def _pitch_mm(scan: Scan) -> float:
    return min(scan.geometry.pixel_size_mm)


def _roll_pixels(scan: Scan) -> float:
    return max(_half_mm(scan, 0), _half_mm(scan, 1)) / _pitch_mm(scan)


def _tilt_pixels(axis: int) -> Callable[[Scan], float]:
    """A tilt magnifies one side: points go outwards by the square of their distance from the axis of the tilt."""
    return lambda scan: _half_mm(scan, axis) ** 2 / scan.geometry.source_to_detector_mm / _pitch_mm(scan)


def _distance_pixels(share: Callable[[Scan], float]) -> Callable[[Scan], float]:
    return lambda scan: share(scan) * max(_half_mm(scan, 0), _half_mm(scan, 1)) / _pitch_mm(scan)


def _timing_pixels(scan: Scan) -> float:
    """A second turns the object's edge by so many pixels."""
    speed_rad_per_s = exposure_arc_rad(scan) / scan.shutter.exposure_s
    edge_mm = max(scan.grid.size_mm[1:]) / 2 * scan.geometry.magnification
    return max(speed_rad_per_s * edge_mm / _pitch_mm(scan), 1e-12)


_DEGREES = math.degrees(1.0)
_SCALE = "a larger or smaller object"
_TURN = "an object turned about the axis"
PARAMETERS = {
    one.name: one
    for one in (
        Parameter(
            "offset-u", "offset_u_mm", "mm", "an object beside the axis",
            lambda s: s.geometry.detector_offset_mm[1], lambda s: 1 / _pitch_mm(s), mismatch=_SMALL_MISMATCH,
        ),
        Parameter(
            "offset-v", "offset_v_mm", "mm", "an object further along the axis",
            lambda s: s.geometry.detector_offset_mm[0], lambda s: 1 / _pitch_mm(s),
        ),
        Parameter("roll", "roll_rad", "deg", "a sheared object", lambda s: 0.0, _roll_pixels, _DEGREES),
        Parameter(
            "tilt-v", "tilt_v_rad", "deg", "a shifted panel", lambda s: 0.0, _tilt_pixels(1), _DEGREES,
            mismatch=_SMALL_MISMATCH,
        ),
        Parameter("tilt-u", "tilt_u_rad", "deg", "an object wider at one end", lambda s: 0.0, _tilt_pixels(0), _DEGREES),
        Parameter(
            "source-distance", "source_distance_mm", "mm", _SCALE,
            lambda s: s.geometry.source_to_axis_mm, _distance_pixels(lambda s: 1 / s.geometry.source_to_axis_mm),
        ),
        Parameter(
            "detector-distance", "detector_distance_mm", "mm", _SCALE,
            lambda s: s.geometry.source_to_detector_mm - s.geometry.source_to_axis_mm,
            _distance_pixels(lambda s: 1 / s.geometry.source_to_detector_mm),
        ),
        Parameter(
            "readout", "readout_s", "s", "an object twisted about the axis",
            lambda s: s.shutter.readout_s, _timing_pixels, is_timing=True,
        ),
        Parameter(
            "exposure", "exposure_s", "s", f"{_TURN}, and smoother or sharper",
            lambda s: s.shutter.exposure_s, _timing_pixels, is_timing=True,
        ),
        Parameter("start", "start_s", "s", _TURN, lambda s: 0.0, _timing_pixels, is_timing=True),
        Parameter("lag", "lag", "%", "an object that is turned and blurred", lambda s: s.lag, lambda s: _PER_ONE, 100.0),
        Parameter("drift", "drift", "%", "an object denser at one side", lambda s: 0.0, lambda s: _PER_ONE, 100.0),
    )
}  # fmt: skip
GAUGE = Parameter("all angles", "turn_rad", "deg", _TURN, lambda s: 0.0, lambda s: _roll_pixels(s), _DEGREES)
"""What no frame can tell: what is left of its signal is what this discretisation leaves of anything."""
GROUPS = {
    "offset": ("offset-u", "offset-v"),
    "tilt": ("tilt-v", "tilt-u"),
    "distance": ("source-distance", "detector-distance"),
    "timing": ("readout", "exposure", "start"),
}
WOBBLE, MOTION, DIRECTION = "wobble", "motion", "direction"


def chosen(what: str | None, scan: Scan, knows_shape: bool = False) -> tuple[list[Parameter], str, bool]:
    """(the parameters that ``what`` names with commas; whether views are asked for one by one or the object's motion, as
    named; whether the readout's direction is); None: those of the panel, of an object of known shape distances and, of a
    fly-scan, readout and exposure. InputError: a name that there is not, views and motion, timing of a gantry at rest."""
    words = [word.strip() for word in (_usual(scan) + ",distance" * knows_shape if what is None else what).split(",")]
    names: list[str] = []
    for word in words:
        if word not in (known := [*GROUPS, *PARAMETERS, WOBBLE, MOTION, DIRECTION]):
            raise InputError("--what", repr(word), ", ".join(known), near_miss(word, known, "name some of them"))
        names += GROUPS.get(word, (word,))
    names = list(dict.fromkeys(names))
    per_view = [name for name in names if name in (WOBBLE, MOTION)]
    if len(per_view) > 1:
        raise InputError("--what", f"{WOBBLE} and {MOTION}", "one of the two: each would take the other's part", "ask twice")
    found = [PARAMETERS[name] for name in names if name in PARAMETERS]
    asks_direction = DIRECTION in names
    timed = [one.name for one in found if one.is_timing] + [DIRECTION] * asks_direction
    if timed and not _turns(scan):
        raise InputError("--what", timed[0], "a parameter of the panel: this gantry stands still in each frame")
    if asks_direction and scan.shutter.readout_s == 0:
        raise InputError(f"--what {DIRECTION}", "a readout of 0 s", "lines that are read one after the other")
    return found, "".join(per_view), asks_direction


def _turns(scan: Scan) -> bool:
    return scan.is_fly and scan.shutter.exposure_s > 0 and exposure_arc_rad(scan) > 0


def _usual(scan: Scan) -> str:
    return "offset,roll,tilt" + ",readout,exposure" * (_turns(scan) and scan.shutter.readout_s > 0)


def change_of(values: Mapping[str, float]) -> Change:
    """A change by the parameters' names, in the units of the fields."""
    fields = {**PARAMETERS, GAUGE.name: GAUGE}
    return Change(**{fields[name].field: float(value) for name, value in values.items()})


def in_words(weights: Mapping[str, float]) -> str:
    """A combination of parameters (weights by name, of their signals' norms), those that matter, the largest first."""
    order = sorted(weights, key=lambda name: -abs(weights[name]))
    largest = abs(weights[order[0]])
    parts = [name for name in order if abs(weights[name]) > 0.3 * largest]
    sign = np.sign(weights[parts[0]])
    text = parts[0] + "".join(f" {'with' if weights[p] * sign > 0 else 'against'} {p}" for p in parts[1:])
    return f"{text}: looks like {PARAMETERS[parts[0]].alike}"
