"""Corrects beam hardening: returns the line integrals that a beam would give if every layer attenuated as a thin one does.

- Polynomial: the user has measured it with a wedge.
- One material: a polynomial of the path through the segmented volume is fitted to line integrals (Krumm, Kasperl and Franz,
  NDT & E Int. 41 (2008) 242).
- Tube voltage: bone in a reconstruction is projected, and the spectrum gives the soft tissue that remains (Joseph and
  Spital, J. Comput. Assist. Tomogr. 2 (1978) 100). This is repeated with the better volume.

For a voltage the user may state the attenuation from which a voxel is bone. Otherwise candidates are tried, also water alone
and no correction. The one whose corrected frames agree best with the projections of their own reconstruction wins."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import Spectrum, tube_spectrum
from phyradgs_cl.detector.attenuation import FILTER_MM, HIGHEST_KVP, LOWEST_KVP
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare import step
from phyradgs_cl.prepare.step import Facts, MakeModel, Model, StepOptions

log = logging.getLogger(__name__)

Polynomial = tuple[float, float, float]
BoneIn = Callable[[np.ndarray], np.ndarray]
"""Maps a volume (z, y, x) to the attenuation of the bone in each voxel."""
_LARGEST = 1e3  # limit of stated coefficients and attenuations: larger ones must be mistakes
_PASSES = 2  # rounds that take bone from a volume and correct frames for it: the second round has better bone
_BONE_VOXELS = 128  # most voxels along the longest side of the volume in which bone is found: hardening by bone is smooth
# Candidates (a, b), fractions of the densest voxel: soft tissue ends at a, pure bone begins at b (above 1: no pure bone).
_BETWEEN = [(soft, bone) for soft in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6) for bone in (0.4, 0.7, 1.0) if soft < bone]
_BETWEEN += [(0.7, 1.0), (0.7, 1.5), (0.8, 1.5)]
# Candidates count as equally good if they improve on water alone by at least 90 % as much as the best one does. Of these
# the one with least bone wins.
_AS_WELL = 0.1
# Bone is corrected even if this leaves up to 2 % more unexplained than water alone does, provided that it leaves less than
# no correction: who states a voltage expects hardening.
_NEARLY = 1.02
_NEWTON = 3  # steps of Newton's method that find the soft tissue: enough for an error of 1e-12
_UNIFORM = 0.08  # the object has several materials if path lengths leave a larger relative RMS of line integrals unexplained
_SHADOW = 0.1  # pixels whose path is longer than this fraction of the longest lie behind the object
_WATER_TO = 8.0  # the polynomial of a voltage is fitted up to this line integral: 40 cm of water at 0.2/cm
_NONE: Polynomial = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class HardeningOptions(StepOptions, step="hardening"):
    """Options of the step ``hardening``: a polynomial, or a tube voltage. With neither, a polynomial is fitted for one
    material.

    - polynomial: coefficients of p², p³ and p⁴. kvp: tube voltage in kV, which gives the spectrum; 0: not stated.
    - bone_per_mm: attenuation in 1/mm from which a voxel is bone; 0: candidates are tried.
    - filter_mm: thickness of aluminium. anode_deg: angle of a tungsten anode, for SpekPy's spectrum; 0: Kramers' law.

    Raises InputError for values out of range or in contradiction."""

    polynomial: Polynomial = checks.ranged(_NONE, -_LARGEST, _LARGEST)
    kvp: float = 0.0
    bone_per_mm: float = checks.ranged(0.0, 0, _LARGEST)
    filter_mm: float = checks.ranged(FILTER_MM, 0, 50)
    anode_deg: float = checks.ranged(0.0, 0, 45)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kvp != 0:
            checks.within("hardening.kvp", self.kvp, LOWEST_KVP, HIGHEST_KVP)
        for name in ("bone_per_mm", "filter_mm", "anode_deg"):
            if getattr(self, name) != getattr(type(self), name) and not self.kvp:
                raise InputError(f"hardening.{name}", "given without hardening.kvp", "both, or neither", "state the voltage")
        if self.kvp and any(self.polynomial):
            raise InputError("hardening.kvp", "given with hardening.polynomial", "one of the two", "leave one out")


def straighten(frames: np.ndarray, polynomial: Polynomial) -> np.ndarray:
    """Returns p + a p² + b p³ + c p⁴, float32, for line integrals p of any shape. polynomial: (a, b, c). Negative p are air
    and stay as they are."""
    p = np.asarray(frames, np.float64)
    up = np.maximum(p, 0)
    square, cube, fourth = polynomial
    return (p + up**2 * (square + up * (cube + up * fourth))).astype(np.float32)


def water_polynomial(kvp: float, filter_mm: float = FILTER_MM, anode_deg: float = 0.0) -> Polynomial:
    """Returns the coefficients that correct line integrals of water, up to 8, under the spectrum of ``tube_spectrum``."""
    true = np.linspace(0.05, _WATER_TO, 80)
    seen = tube_spectrum(kvp, filter_mm, anode_deg).hardened(true)
    basis = np.stack([seen**2, seen**3, seen**4], axis=1) / true[:, None]
    square, cube, fourth = np.linalg.lstsq(basis, (true - seen) / true, rcond=None)[0].tolist()
    return square, cube, fourth


def correct_hardening(scan: Scan, options: HardeningOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    if options.kvp:
        return _by_voltage(scan, options, make_model)
    frames, fitted = step.unmasked_frames(scan), not any(options.polynomial)
    polynomial = fit_polynomial(frames, make_model(scan)) if fitted else options.polynomial
    largest = float(frames.max())
    p = np.linspace(0, max(largest, 1e-6), 100)
    if (falls := np.diff(straighten(p, polynomial)) <= 0).any():
        found = f"{list(polynomial)}, which falls from line integrals of {p[np.argmax(falls)]:.3g} on"
        raise InputError("hardening.polynomial", found, f"one that rises up to the largest, {largest:.3g}")
    facts = {"polynomial": list(polynomial), "fitted": fitted}
    return replace(scan, projections=straighten(frames, polynomial)), facts


def _by_voltage(scan: Scan, options: HardeningOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    tube = (options.kvp, options.filter_mm, options.anode_deg)
    frames = step.unmasked_frames(scan)
    spectrum, water = tube_spectrum(*tube), water_polynomial(*tube)
    facts: Facts = {"kvp": options.kvp}
    bone_in: BoneIn = lambda volume: np.where(volume >= options.bone_per_mm, volume, 0)  # noqa: E731
    if not options.bone_per_mm:
        model, blur = step.coarse_model(scan, make_model)
        mixed, facts["unexplained"] = find_bone(step.smooth(frames, blur), spectrum, water, model)
        if mixed is None:
            result = f"no correction at {options.kvp:g} kV explains the projections better: they stay as they are"
            log.warning("hardening: %s", result)
            return scan, {**facts, "result": result}
        bone_in = partial(_between, *mixed)
        facts |= dict(zip(("soft_to", "bone_from"), mixed, strict=True)) if np.isfinite(mixed[0]) else {}
    fine = step.coarse_model(scan, make_model, _BONE_VOXELS)
    clean, facts["bone_share"] = _straighten_two(frames, spectrum, *fine, water, bone_in)
    return replace(scan, projections=clean), facts


def _straighten_two(
    frames: np.ndarray, spectrum: Spectrum, model: Model, blur: float, water: Polynomial, bone_in: BoneIn
) -> tuple[np.ndarray, float]:
    """Returns line integrals (F, v, u) corrected for soft tissue and bone, and bone's fraction of the volume's attenuation.
    Without bone they are corrected by the polynomial ``water``. blur: standard deviation in pixels of the blur of frames for
    ``model``. bone_in: returns the bone of a volume, as ``BoneIn``."""
    clean, share = straighten(frames, water), 0.0
    for _ in range(_PASSES):
        volume = model.regularised(step.smooth(clean, blur))
        bone = bone_in(volume)
        if not bone.any():
            break
        share = float(bone.sum() / np.maximum(volume, 0).sum())
        clean = _with_bone(bone, frames, spectrum, model)
    return clean, share


def find_bone(
    frames: np.ndarray, spectrum: Spectrum, water: Polynomial, model: Model
) -> tuple[tuple[float, float] | None, dict[str, float]]:
    """Finds the candidate (``_BETWEEN``) whose corrected line integrals (F, v, u) agree best with their own reprojection.

    Returns two fractions of the densest voxel: voxels up to the first are soft tissue, voxels from the second on are bone.
    Both are infinite if water alone is best; None means no correction. Also returns the rest that each alternative leaves
    unexplained. Raises InputError without an object."""

    def rest_of(clean: np.ndarray) -> float:
        return step.unexplained(clean, model.volume(clean), inside, model)

    clean = straighten(frames, water)
    first = model.volume(clean)
    if step.densest(first) <= 0:
        raise _no_object()
    inside = step.object_in(first)
    uncorrected, water_alone = rest_of(frames), rest_of(clean)
    volume = model.regularised(clean)
    bones = {pair: _between(*pair, volume) for pair in _BETWEEN}
    rest = {pair: rest_of(_with_bone(bone, frames, spectrum, model)) for pair, bone in bones.items()}
    least = min(rest.values())
    good = [pair for pair in bones if rest[pair] <= least + _AS_WELL * max(water_alone - least, 0.0)]
    best = min(good, key=lambda pair: float(bones[pair].sum()))
    rests = {"as_they_are": uncorrected, "water": water_alone, "bone": rest[best]}
    if rest[best] < uncorrected and rest[best] <= _NEARLY * water_alone:
        return best, rests
    return ((np.inf, np.inf) if water_alone < uncorrected else None), rests


def _with_bone(bone: np.ndarray, frames: np.ndarray, spectrum: Spectrum, model: Model) -> np.ndarray:
    """Returns line integrals (F, v, u) of bone (z, y, x) and of the soft tissue that, with it, gives ``frames``."""
    dense = np.maximum(model.frames(bone.astype(np.float32)), 0)
    soft, small = np.asarray(frames - dense, np.float64), 1e-3
    for _ in range(_NEWTON):
        now = spectrum.hardened(soft, dense)
        soft = soft - small * (now - frames) / (spectrum.hardened(soft + small, dense) - now)
    return (soft + dense).astype(np.float32)


def fit_polynomial(frames: np.ndarray, model: Model) -> Polynomial:
    """Fits the polynomial of ``straighten``, with p² alone, to line integrals (F, v, u) of an object of one material.

    The coefficient that the same fit finds in a reprojection of the volume, which has no hardening, is subtracted. Raises
    InputError for an object of several materials, and if there is no object."""
    path, level, bend, rest = _bend(frames, model)
    if rest > _UNIFORM:
        found = f"{100 * rest:.2g} % of the line integrals that the path through one material does not explain"
        remedy = "state hardening.kvp or hardening.polynomial"
        raise InputError("--steps hardening", found, f"at most {100 * _UNIFORM:.2g} %", remedy)
    # voxels cause a small quadratic term even without hardening: it is measured in their reprojection, and subtracted
    return _bend(path * np.float32(level), model)[2] - bend, 0.0, 0.0


def _bend(frames: np.ndarray, model: Model) -> tuple[np.ndarray, float, float, float]:
    """Fits p = t + b t² to line integrals (F, v, u), where t is the path through the object times its attenuation. Returns
    the path (F, v, u) in mm, the attenuation of the object's voxels in 1/mm, b, and the relative RMS of the residual."""
    volume = model.volume(frames)
    level = float(np.median(volume[volume > 0.5 * np.percentile(volume, 99)])) if volume.max() > 0 else 0.0
    path = model.frames(np.clip(volume / max(level, 1e-20), 0, 1).astype(np.float32))
    through = path > _SHADOW * float(path.max())
    if level <= 0 or not through.any():
        raise _no_object()
    length, seen = path[through].astype(np.float64), frames[through].astype(np.float64)
    powers = np.stack([length, length**2], axis=1)
    fit = np.linalg.lstsq(powers, seen, rcond=None)[0]
    rest = float(np.sqrt(np.mean((seen - powers @ fit) ** 2) / np.mean(seen**2)))
    return path, level, float(fit[1] / fit[0] ** 2), rest


def _no_object() -> InputError:
    return InputError("--steps hardening", "nothing in the volume", "an object", "leave the step out")


def _between(soft_to: float, bone_from: float, volume: np.ndarray) -> np.ndarray:
    """Returns the attenuation (z, y, x) that bone contributes to voxels that mix it with soft tissue. Both limits are
    fractions of the ``densest`` voxel's attenuation: up to ``soft_to`` nothing is bone, from ``bone_from`` on all is."""
    if soft_to >= bone_from:
        return np.zeros_like(volume)
    soft, bone = soft_to * step.densest(volume), bone_from * step.densest(volume)
    return np.clip((volume - soft) * (bone / (bone - soft)), 0, np.maximum(volume, 0))
