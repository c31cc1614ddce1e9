"""Options of a simulation and their ranges, with the scanner's values as defaults."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from phyradgs_cl import checks, resource
from phyradgs_cl.acquisition import Protocol, make_protocol
from phyradgs_cl.acquisition.readout import check_readout, readout_order
from phyradgs_cl.acquisition.scan import LARGEST_LAG
from phyradgs_cl.detector.attenuation import HIGHEST_KVP, LOWEST_KVP
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import Scanner, load_scanner, with_detector_count
from phyradgs_cl.simulation.object_motion import ObjectMotion, load_object_motion

_NOISES = ("none", "tigre", "beer")
# Limits of options: far beyond any scanner, and far below an overflow of float32 or of a sampler.
_LARGEST_PEAK = 1e4  # upper limit of the largest line integral
_LARGEST_NOISE = 1e9  # upper limit of the electronic noise in counts
_SMALLEST_DOSE, _LARGEST_DOSE = 1e-3, 1e12  # limits of the dose in photons per pixel
_LARGEST_DETECTOR = 32_000  # most pixels along a side of the panel
_TIMING = ("views", "exposure_deg", "readout_ratio", "start_deg", "pulse", "turns")
_DATA_SHEET = ("first", "fps", "readout_ms")


@dataclass(frozen=True)
class SimulationOptions:
    """Options of a simulation. ``peak`` > 0 scales attenuation so that the largest line integral is ``peak``.

    - time_samples: midpoint samples in the exposure of a line. With 0, the volume's edge and a moving object move at most
      half a voxel of ``grid`` between two samples (docs/mathematics.md).
    - dose: photons of a pixel without object, on a line that sees the whole pulse.
    - lag (λ), rings, sparks, drift, scatter: as in detector/effects.py; 0 is without.
    - kvp: as in detector/attenuation.py; 0 is a beam of one energy.
    - motion_of_object: how the object moves during the scan. None: it rests."""

    protocol: Protocol = Protocol()
    readout_axis: str = "rows"
    readout_direction: int = 1
    detector_model: str = "log"
    peak: float = checks.ranged(0.0, 0, _LARGEST_PEAK)
    noise: str = "none"
    dose: float = checks.ranged(1e4, _SMALLEST_DOSE, _LARGEST_DOSE, "--dose (photons per pixel)")
    electronic_noise: float = checks.ranged(10.0, 0, _LARGEST_NOISE, "--electronic-noise (counts)")
    jitter_deg: float = checks.ranged(0.0, 0, 360, "--jitter-deg")
    lag: float = checks.ranged(0.0, 0, LARGEST_LAG)
    time_samples: int = checks.ranged(0, 0, 10_000, "--time-samples")
    seed: int = checks.ranged(0, 0, 2**63)
    rings: float = checks.ranged(0.0, 0, 0.5)
    sparks: float = checks.ranged(0.0, 0, 0.1)
    drift: float = checks.ranged(0.0, 0, 0.5)
    scatter: float = checks.ranged(0.0, 0, 10)
    kvp: float = 0.0
    motion_of_object: ObjectMotion | None = None

    def __post_init__(self) -> None:
        if self.noise not in _NOISES:
            raise InputError("--noise", repr(self.noise), f"one of {', '.join(_NOISES)}")
        checks.fields_within("--", self)
        if not isinstance(self.motion_of_object, ObjectMotion | None):
            expected = "an ObjectMotion, or the path of a TOML file"
            raise InputError("--motion-of-object", checks.short_repr(self.motion_of_object), expected)
        if self.kvp != 0:
            checks.within("--kvp (kV)", self.kvp, LOWEST_KVP, HIGHEST_KVP)


OPTION_NAMES = frozenset({f.name for f in fields(SimulationOptions)} - {"protocol"}).union(_TIMING, _DATA_SHEET)
"""The names that ``scanner_options`` takes."""


def scanner_for(
    name: str, detector: int | None = None, detector_offset_mm: tuple[float, float] | None = None,
    truncation: float = 0.0
) -> Scanner:
    """Returns a scanner by name or TOML file.

    detector: another number of columns, with rows in proportion. detector_offset_mm: the panel's offset (v, u). truncation:
    the fraction of the columns to cut off, half at each side."""
    scanner = load_scanner(name, resource("data"))
    geometry = scanner.geometry
    if detector is not None:
        checks.within("--detector", detector, 1, _LARGEST_DETECTOR)
        rows, columns = geometry.detector_shape
        geometry = with_detector_count(geometry, max(1, round(detector * rows / columns)), detector)
    if detector_offset_mm is not None:
        geometry = replace(geometry, detector_offset_mm=detector_offset_mm)
    checks.within("--truncation", truncation, 0, 0.95)
    rows, columns = geometry.detector_shape
    remaining = max(1, columns - 2 * round(truncation * columns / 2))
    return replace(scanner, geometry=replace(geometry, detector_shape=(rows, remaining)))


def scanner_options(scanner: Scanner, protocol: str, **given: Any) -> SimulationOptions:
    """Returns options of a simulation with a named protocol. The scanner's value, or the default, stands for options that
    are missing or None.

    Raises InputError for unknown options, values out of range, and values that contradict each other."""
    given = {key: value for key, value in given.items() if value is not None}
    order = readout_order(given.get("first"), given.get("readout_axis"), given.get("readout_direction"), _flag)
    keys = ("readout_axis", "readout_direction", "lag", "readout_ratio", "pulse", "fps", "readout_ms")
    of_scanner = {key: getattr(scanner, key) for key in keys}
    if "readout_ratio" in given or "readout_ms" in given:  # either of these replaces both of the scanner
        del of_scanner["readout_ratio"], of_scanner["readout_ms"]
    values = {**of_scanner, **given}
    values.update({key: value for key, value in zip(keys, order, strict=False) if value is not None})

    def named(name: str) -> str:
        is_scanner_s = name not in given and of_scanner.get(name) is not None
        return f"{scanner.name} [readout] {name}" if is_scanner_s else _flag(name)

    check_readout(values.get("readout_ms"), values.get("readout_ratio"), values.get("fps"), named)
    if unknown := sorted(set(values) - OPTION_NAMES):
        expected = f"one of {', '.join(sorted(OPTION_NAMES))}"
        raise InputError(f"simulate: option {unknown[0]}", "no such option", expected)
    timing = {key: values.pop(key) for key in _TIMING if key in values}
    sheet = {key: values.pop(key, None) for key in _DATA_SHEET}
    timed = make_protocol(protocol, **timing)
    if sheet["fps"] is not None:
        timed = timed.at_rate(sheet["fps"], sheet["readout_ms"], named)
    if isinstance(values.get("motion_of_object"), str | Path):
        values["motion_of_object"] = load_object_motion(values["motion_of_object"])
    return SimulationOptions(protocol=timed, **values)


def _flag(name: str) -> str:
    return {"readout_axis": "--readout"}.get(name, "--" + name.replace("_", "-"))
