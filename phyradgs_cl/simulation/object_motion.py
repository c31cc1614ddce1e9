"""Turns the presets of a TOML file, which say how a simulated object moves, into deformations.

Breathing follows A. E. Lujan et al., Med. Phys. 26, 715-720 (1999): a(φ) = 1 − cos⁴(π φ) at the phase φ of a breath."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, control_points
from phyradgs_cl.io.tables import Fields, read_toml

_NODES = 40  # weights stored per cycle; linear interpolation between them is then off by 0.3 % at most
_SETTLING_NODES = 200  # number of times at which the weights of "drying" are stored: enough for their smooth curve
_SPACINGS = 8.0  # breathing and drying are smooth, so this many spacings of control points along the longest side are enough
_SLIDING_SPACINGS = 16.0  # the edge of "sliding" is sharp: the spline makes it about three control points wide
_ASIDE = 1 / 3  # breathing moves the object along y, too, by this fraction of its motion along z
_PERIODS = (0.5, 1.5)  # least and largest duration of a random breath, in mean periods
_FADE = 3.0  # beyond the box, motion falls to 0 over this many amplitudes, a slope of a third, so that the field cannot fold
_MOST_CYCLES = 100_000  # most cycles of breathing or sliding in a scan: more would mean a wrong unit of time
_COMMON = ("kind", "amplitude_mm", "amplitude", "states")
_KEYS = {
    "breathing": (*_COMMON, "period_s", "jitter", "hysteresis", "seed"),
    "drying": (*_COMMON, "settling_s"),
    "sliding": (*_COMMON, "period_s", "radius"),
}
Array = np.ndarray


@dataclass(frozen=True)
class ObjectMotion(checks.Checked):
    """A known motion of the object, by a preset.

    kind: "breathing" lowers the object, most at its top and not at its base, and moves it along y a little later. "drying"
    lowers its top and shrinks it sideways, and never returns. "sliding" moves a cylinder about the z axis up and down in
    surroundings at rest.

    - amplitude_mm: the limit of the displacement along z. None takes ``amplitude`` times half of the box's shortest side.
    - period_s: the time of a breath, or of sliding up and down. jitter: (standard deviation of breaths' periods)/period_s.
    - hysteresis: the delay of the motion along y, in periods.
    - settling_s: the time in which drying goes 63 % of its way. None takes a third of the scan.
    - radius: (radius of the sliding cylinder)/(half of the box's shortest side). seed: of the jitter's random numbers.
    - states: at how many times the true volume is stored.

    Raises InputError for an unknown kind and for numbers out of range."""

    PREFIX = "motion of the object: "

    kind: str = field(metadata={"words": tuple(_KEYS)})
    amplitude_mm: float | None = checks.ranged(None, 0, 1e9)
    amplitude: float = checks.ranged(0.15, 0, 1)
    period_s: float = checks.ranged(4.0, 1e-6, 1e9)
    jitter: float = checks.ranged(0.1, 0, 1)
    hysteresis: float = checks.ranged(0.1, 0, 0.5)
    settling_s: float | None = checks.option(None, is_positive=True)
    radius: float = checks.ranged(0.4, 0.05, 1)
    seed: int = checks.ranged(0, 0, 2**63)
    states: int = checks.ranged(10, 1, 1000)

    def deformation(self, box: Grid, first_s: float, last_s: float) -> Deformation:
        """Returns the deformation of an object in ``box``, from a scan's first light to its last, first_s to last_s in s.

        Raises InputError for an amplitude above half of the box's shortest side, and for more than 100 000 cycles."""
        half_mm = min(box.size_mm) / 2
        amplitude_mm = self.amplitude * half_mm if self.amplitude_mm is None else self.amplitude_mm
        if amplitude_mm > half_mm:
            expected = f"at most half of the box's shortest side, {half_mm:.4g} mm"
            raise InputError("motion of the object: amplitude_mm", f"{amplitude_mm:g}", expected)
        make = {"breathing": _breathing_mm, "drying": _drying_mm, "sliding": self._sliding_mm}[self.kind]
        spacings = _SLIDING_SPACINGS if self.kind == "sliding" else _SPACINGS
        spacing_mm = max(box.size_mm) / spacings
        origin_mm, counts = control_points(box, spacing_mm, spacing_mm + _FADE * amplitude_mm)
        axes = [first + np.arange(n) * spacing_mm for first, n in zip(origin_mm[::-1], counts, strict=True)]
        z, y, x = np.meshgrid(*axes, indexing="ij")
        from_middle_mm = [c - middle for c, middle in zip((z, y, x), box.offset_mm, strict=True)]
        outside_mm = np.max([np.abs(c) - side / 2 for c, side in zip(from_middle_mm, box.size_mm, strict=True)], axis=0)
        fade = 1 - np.clip((outside_mm - spacing_mm) / max(_FADE * amplitude_mm, spacing_mm), 0, 1)
        height = np.clip(from_middle_mm[0] / box.size_mm[0] + 0.5, 0, 1)
        control_mm = amplitude_mm * np.stack(make([c / half_mm for c in from_middle_mm], height)) * fade[..., None]
        times_s, weights = self._weights(first_s, last_s)
        return Deformation(control_mm, origin_mm, spacing_mm, times_s, weights)

    def state_times_s(self, first_s: float, last_s: float) -> Array:
        """Returns the times (K,) in s of the true volumes: the middles of equal parts of the cycle in the middle of the
        scan. For a motion that does not repeat, the parts divide the whole scan."""
        parts = (np.arange(self.states) + 0.5) / self.states
        if self.kind == "drying":
            return np.asarray(first_s + parts * (last_s - first_s))
        begins_s = self._cycles_s(first_s, last_s)
        k = int(np.clip(np.searchsorted(begins_s, (first_s + last_s) / 2) - 1, 0, len(begins_s) - 2))
        first, last = max(begins_s[k], first_s), min(begins_s[k + 1], last_s)
        return np.asarray(first + parts * (last - first))

    def _sliding_mm(self, places: list[Array], height: Array) -> list[Array]:
        """Returns the control vectors of a cylinder about the z axis that moves along z, for unit amplitude. The cylinder's
        edge becomes about three control points wide. places: z, y, x of control points from the box's middle, in units of
        half the box's shortest side."""
        _, y, x = places
        return [_vectors(z=(np.hypot(x, y) < self.radius).astype(float))]

    def _cycles_s(self, first_s: float, last_s: float) -> Array:
        """Returns when each cycle of the motion in the scan begins, and when the last cycle ends, in s. The first cycle
        begins at first light."""
        count = int(np.ceil((last_s - first_s) / self.period_s)) + 1
        if count > _MOST_CYCLES:
            expected = f"at most {_MOST_CYCLES} cycles in the scan's {last_s - first_s:.4g} s"
            raise InputError("motion of the object: period_s", f"{self.period_s:g}", expected)
        jitter = self.jitter if self.kind == "breathing" else 0.0
        draws = np.random.default_rng(self.seed).normal(0, 1, 2 * count + 2)
        periods_s = self.period_s * np.clip(1 + jitter * draws, *_PERIODS)
        begins_s = first_s + np.concatenate([[0.0], np.cumsum(periods_s)])
        return np.asarray(begins_s[: int(np.searchsorted(begins_s, last_s)) + 1])

    def _weights(self, first_s: float, last_s: float) -> tuple[Array, Array]:
        """Returns times (T,) in s, and the weights (T, R) of the R displacement fields at these times."""
        if self.kind == "drying":
            settling_s = (last_s - first_s) / 3 if self.settling_s is None else self.settling_s
            times_s = np.linspace(first_s, max(last_s, np.nextafter(first_s, np.inf)), _SETTLING_NODES)
            passed = (times_s - first_s) / max(settling_s, 1e-300)
            return times_s, np.stack([1 - np.exp(-passed), 1 - np.exp(-passed / 2)], -1)
        begins_s = self._cycles_s(first_s, last_s)
        phase = np.arange((len(begins_s) - 1) * _NODES + 1) / _NODES
        times_s = np.interp(phase, np.arange(len(begins_s)), begins_s)
        if self.kind == "sliding":
            return times_s, np.sin(2 * np.pi * phase)[:, None]
        return times_s, np.stack([_breath(phase), _breath(phase - self.hysteresis)], -1)


def load_object_motion(path: str | Path) -> ObjectMotion:
    """Loads the motion of an object from a TOML file. Raises InputError for a missing file, for keys that its kind does not
    have, and for values out of range."""
    content = read_toml(Path(path))
    kind = content.get("kind")
    checks.one_of(f"{path} kind", kind, _KEYS)
    fields = Fields(str(path), content, _KEYS[str(kind)])
    if fields.has("amplitude_mm") and fields.has("amplitude"):
        raise fields.error("amplitude", "both it and amplitude_mm", "one of the two", "leave one out")
    numbers = {key: fields.number(key) for key in content if key != "kind"}
    for key in {"seed", "states"} & set(numbers):
        numbers[key] = fields.count(key, 2**31) if key == "states" else int(numbers[key])
    try:
        return ObjectMotion(str(kind), **numbers)  # type: ignore[arg-type]
    except InputError as error:
        name = error.subject.removeprefix("motion of the object: ")
        raise InputError(f"{path} {name}", error.found, error.expected, error.remedy) from error


def _breath(phase: Array) -> Array:
    """Returns (displacement)/(amplitude) of a breath at a phase in cycles: 0 at whole numbers, 1 half-way between."""
    return np.asarray(1 - np.cos(np.pi * phase) ** 4)


def _breathing_mm(places: list[Array], height: Array) -> list[Array]:
    """Returns two sets of control vectors: along z with unit amplitude, and along −y with a third of it. Both grow with
    ``height``, which is 0 at the box's base and 1 at its top."""
    share = height**2 * (3 - 2 * height)
    return [_vectors(z=share), _vectors(y=-_ASIDE * share)]


def _drying_mm(places: list[Array], height: Array) -> list[Array]:
    """Returns two sets of control vectors of unit amplitude: one lowers the object, in proportion to height; one shrinks it
    towards the z axis. places, height: as in ``_sliding_mm`` and ``_breathing_mm``."""
    _, y, x = places
    return [_vectors(z=height), _vectors(x=x / 2, y=y / 2)]


def _vectors(x: Array | float = 0.0, y: Array | float = 0.0, z: Array | float = 0.0) -> Array:
    return np.stack(np.broadcast_arrays(x, y, z), -1)
