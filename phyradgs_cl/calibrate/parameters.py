"""The parameters that can be calibrated: name, unit, stated value, step, and which other object would look the same."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import ConeGeometry, Scan
from phyradgs_cl.acquisition.altered.angles import exposure_arc_rad
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection
from phyradgs_cl.errors import InputError
from phyradgs_cl.removed import removal
from phyradgs_cl.text import suggest_name

_STEP_PX = 0.25  # a central difference moves the image's edge by this many pixels to each side
_TIMING_STEP = 0.1  # a central difference changes an exposure or readout above 0 by at most this fraction of it
_LARGEST_CUT = 0.7  # the search shortens exposure or readout by at most this fraction, so that the time stays above 0
_MOST_TILT_RAD = math.radians(2.0)  # a central difference changes an angle by at most this
# ``Parameter.mismatch`` of parameters whose effect changes sign after half a turn. Errors of voxels keep their sign, so they
# disturb such parameters less.
_SMALL_MISMATCH = 1.3
# An angle with a larger standard deviation counts as undetermined, because its sine is not linear over such a range.
_LEAST_KNOWN_RAD = math.radians(10.0)
# An estimated angle beyond this is an error of the model. A stand that leans so much is seen by eye, and poses state it.
_MOST_LEAN_RAD = math.radians(10.0)
_DEGREES = math.degrees(1.0)


@dataclass(frozen=True)
class Parameter:
    """A parameter that can be calibrated. field: the field of ``GeometryCorrection`` that it changes.

    - stated: the value that a scan states, in the field's unit. scale: (displayed value) / (value in the field's unit).
    - object_instead: another object that explains the frames as well, if they do not determine the parameter.
    - pixels: how many pixels a unit of the field moves the image at its edge.
    - mismatch: (measured errors) / (errors by noise alone), see docs/calibrate.md. Voxels cause the difference, because
      they do not represent objects exactly.
    - is_axial: the parameter moves the image along the axis, like ``LIFT``. The others move it across, like ``TURN``."""

    name: str
    field: str
    unit: str
    object_instead: str
    stated: Callable[[Scan], float]
    pixels: Callable[[Scan], float]
    scale: float = 1.0
    is_timing: bool = False
    mismatch: float = 2.0
    is_axial: bool = False

    def step(self, scan: Scan) -> float:
        """Returns how far a central difference goes to each side, in the field's unit."""
        step = _STEP_PX / self.pixels(scan)
        if self.unit == "deg":
            return min(step, _MOST_TILT_RAD)
        return min(step, _TIMING_STEP * self.stated(scan) or step) if self.is_timing else step

    def is_known(self, deviation: float) -> bool:
        """Returns whether a value with the standard deviation ``deviation``, in the field's unit, is of use. Only an angle
        can be too uncertain."""
        return self.unit != "deg" or deviation < _LEAST_KNOWN_RAD

    def is_possible(self, value: float) -> bool:
        """Returns whether a scanner may differ by ``value``, in the field's unit, from what its scan states."""
        return self.unit != "deg" or abs(value) <= _MOST_LEAN_RAD

    def lowest(self, scan: Scan) -> float:
        """Returns the lowest correction that the search may try: −0.7 times a stated time above 0, otherwise −∞."""
        stated = self.stated(scan) if self.is_timing else 0.0
        return -_LARGEST_CUT * stated if stated > 0 else -math.inf


def _half_mm(scan: Scan, axis: int) -> float:
    return scan.geometry.detector_shape[axis] * scan.geometry.pixel_size_mm[axis] / 2


def _pitch_mm(scan: Scan) -> float:
    return min(scan.geometry.pixel_size_mm)


def _edge_pixels(scan: Scan, factor: float = 1.0) -> float:
    """Returns ``factor`` × (number of pixels by which a roll of 1 rad moves the panel's edge farthest from the middle)."""
    return factor * max(_half_mm(scan, 0), _half_mm(scan, 1)) / _pitch_mm(scan)


def _tilt_pixels(axis: int) -> Callable[[Scan], float]:
    """Returns a function of the scan: by how many pixels a tilt of 1 rad moves the panel's edge at the end of v (``axis`` 0)
    or u (``axis`` 1). A tilt magnifies one side, and moves a point in proportion to (distance from the tilt's axis)²."""
    return lambda scan: _half_mm(scan, axis) ** 2 / _cone(scan).source_to_detector_mm / _pitch_mm(scan)


def _cone(scan: Scan) -> ConeGeometry:
    """Returns the scan's geometry, a cone beam's: ``requested`` refuses tilts and distances of parallel beams."""
    assert isinstance(scan.geometry, ConeGeometry)
    return scan.geometry


def _timing_pixels(scan: Scan) -> float:
    """Returns by how many pixels per second the image of the grid's edge moves as the gantry turns; at least 1e-12."""
    speed_rad_per_s = exposure_arc_rad(scan) / scan.shutter.exposure_s
    edge_mm = max(scan.grid.size_mm[1:]) / 2 * scan.geometry.magnification
    return max(speed_rad_per_s * edge_mm / _pitch_mm(scan), 1e-12)


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
            lambda s: s.geometry.detector_offset_mm[0], lambda s: 1 / _pitch_mm(s), is_axial=True,
        ),
        Parameter("roll", "roll_rad", "deg", "a sheared object", lambda s: 0.0, _edge_pixels, _DEGREES),
        Parameter(
            "tilt-v", "tilt_v_rad", "deg", "a shifted panel", lambda s: 0.0, _tilt_pixels(1), _DEGREES,
            mismatch=_SMALL_MISMATCH,
        ),
        Parameter(
            "tilt-u", "tilt_u_rad", "deg", "an object wider at one end", lambda s: 0.0, _tilt_pixels(0), _DEGREES,
            is_axial=True,
        ),
        Parameter(
            "source-distance", "source_distance_mm", "mm", _SCALE,
            lambda s: _cone(s).source_to_axis_mm, lambda s: _edge_pixels(s, 1 / _cone(s).source_to_axis_mm),
        ),
        Parameter(
            "detector-distance", "detector_distance_mm", "mm", _SCALE,
            lambda s: _cone(s).source_to_detector_mm - _cone(s).source_to_axis_mm,
            lambda s: _edge_pixels(s, 1 / _cone(s).source_to_detector_mm),
        ),
        Parameter(
            "readout", "readout_s", "s", "an object twisted about the axis",
            lambda s: s.shutter.readout_s, _timing_pixels, is_timing=True,
        ),
        Parameter(
            "exposure", "exposure_s", "s", f"{_TURN}, and smoother or sharper",
            lambda s: s.shutter.exposure_s, _timing_pixels, is_timing=True,
        ),
    )
}  # fmt: skip
OFFSET_U = "offset-u"
BEYOND_PANEL = ("offset-v", "tilt-v", "tilt-u")
"""Parameters whose errors an object that reaches beyond the panel's sides resembles: they change how far each side sees."""
TURN = Parameter("all angles", "turn_rad", "deg", _TURN, lambda s: 0.0, _edge_pixels, _DEGREES)
LIFT = Parameter("all heights", "lift_mm", "mm", "a lower object", lambda s: 0.0, lambda s: 1 / _pitch_mm(s), is_axial=True)
GAUGES = (TURN, LIFT)
"""Parameters that no frame determines. The part of their effect that no volume explains is due to errors of voxels alone."""
PARAMETER_GROUPS = {
    "offset": (OFFSET_U, "offset-v"),
    "tilt": ("tilt-v", "tilt-u"),
    "distance": ("source-distance", "detector-distance"),
    "timing": ("readout", "exposure"),
}
_CONE_ONLY = (*PARAMETER_GROUPS["tilt"], *PARAMETER_GROUPS["distance"])
WOBBLE, MOTION, DIRECTION = "wobble", "motion", "direction"
NAMES = list(dict.fromkeys([*PARAMETER_GROUPS, *PARAMETERS, WOBBLE, MOTION, DIRECTION]))


@dataclass(frozen=True)
class Request:
    """What to estimate. parameters: those that all views share. per_view: "wobble", "motion" or "". asks_direction: whether
    to test which line is read first."""

    parameters: list[Parameter]
    per_view: str
    asks_direction: bool

    @property
    def names(self) -> list[str]:
        return [one.name for one in self.parameters]


def requested(what: str | None, scan: Scan, knows_shape: bool = False) -> Request:
    """Returns the request that ``what`` states, names separated by commas. knows_shape: the object's shape is known.

    None stands for offset, roll and tilt. It adds readout and exposure in a fly-scan with a rolling readout, and distances
    for an object of known shape. A parallel beam has neither tilt nor distances.

    Raises InputError for an unknown name, distances and tilts of a parallel beam, wobble together with motion, the timing of
    a gantry that stands still, and readout or direction where the stated readout is 0 s."""
    if what is None:
        is_rolling = _turns(scan) and scan.shutter.readout_s > 0
        what = "offset,roll" if scan.is_parallel else "offset,roll,tilt"
        what += ",readout,exposure" if is_rolling else ""
        what += ",distance" if knows_shape and not scan.is_parallel else ""
    names: list[str] = []
    for word in (word.strip() for word in what.split(",")):
        if left := removal(f"--what {word}"):
            raise left
        if word not in NAMES:
            raise InputError("--what", repr(word), ", ".join(NAMES), suggest_name(word, NAMES, "name some of them"))
        names += PARAMETER_GROUPS.get(word, (word,))
    names = list(dict.fromkeys(names))
    of_cone = [name for name in names if scan.is_parallel and name in _CONE_ONLY]
    if of_cone:
        raise InputError("--what", f"{of_cone[0]} of a parallel beam", "offset-u, offset-v or roll", "leave it out")
    if WOBBLE in names and MOTION in names:
        expected = "one of the two, because each explains the other"
        raise InputError("--what", f"{WOBBLE} and {MOTION}", expected, "run it twice")
    per_view = next((name for name in names if name in (WOBBLE, MOTION)), "")
    request = Request([PARAMETERS[name] for name in names if name in PARAMETERS], per_view, DIRECTION in names)
    timed = [name for name in names if name == DIRECTION or (name in PARAMETERS and PARAMETERS[name].is_timing)]
    if timed and not _turns(scan):
        raise InputError("--what", timed[0], "a parameter of the panel: this gantry stands still in each frame")
    of_readout = next((name for name in names if name in (DIRECTION, "readout")), "")
    if of_readout and scan.shutter.readout_s == 0:
        remedy = "state the readout that the panel may have, or leave it out: exposure alone can be estimated"
        raise InputError(f"--what {of_readout}", "a readout of 0 s", "lines that are read one after the other", remedy)
    return request


def _turns(scan: Scan) -> bool:
    return scan.is_fly and scan.shutter.exposure_s > 0 and exposure_arc_rad(scan) > 0


def correction_of(values: Mapping[str, float]) -> GeometryCorrection:
    """Returns the correction with the ``values`` of parameters, by name and in its fields' units; other fields are 0."""
    fields = {**PARAMETERS, **{gauge.name: gauge for gauge in GAUGES}}
    return GeometryCorrection(**{fields[name].field: float(value) for name, value in values.items()})


def in_words(weights: Mapping[str, float]) -> str:
    """Returns a combination of parameters in words, with the other object that looks the same. The parameter of the largest
    weight comes first. Parameters of at most 0.3 times this weight are left out. weights: by name."""
    order = sorted(weights, key=lambda name: -abs(weights[name]))
    largest = abs(weights[order[0]])
    main, *others = [name for name in order if abs(weights[name]) > 0.3 * largest]
    sign = np.sign(weights[main])
    text = main + "".join(f" {'with' if weights[name] * sign > 0 else 'against'} {name}" for name in others)
    return f"{text}: looks like {PARAMETERS[main].object_instead}"
