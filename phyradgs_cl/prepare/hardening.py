"""Beam hardening undone: line integrals as they are in the thinnest layer.

By a polynomial that was measured with a wedge. Or by the tube's voltage: what is bone in the scan's own volume, one with
little total variation, is reprojected, and the spectrum says what soft tissue is left (Joseph and Spital, J. Comput. Assist.
Tomogr. 2 (1978) 100), again as the volume gets better. Where bone begins is stated, or it is tried: the frames that their
own reprojection explains best win, those as they are and those of water alone among them. Or, of an object of one material,
by the scan's consistency with its own reprojection: how line integrals grow with the path through the segmented volume says
the polynomial (Krumm, Kasperl and Franz, NDT & E Int. 41 (2008) 242).
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import Spectrum, tube_spectrum
from phyradgs_cl.detector.spectrum import FILTER_MM, HIGHEST_KVP, LOWEST_KVP
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.consistency import coarse_model, densest, object_in, smooth, unexplained
from phyradgs_cl.prepare.masked import unmasked_frames
from phyradgs_cl.prepare.step import Facts, MakeModel, Model

log = logging.getLogger(__name__)

Polynomial = tuple[float, float, float]
BoneIn = Callable[[np.ndarray], np.ndarray]
"""From a volume (z, y, x), the attenuation in each voxel that is bone's."""
_LARGEST = 1e3
_PASSES = 2  # of bone from volume from bone
_BONE_VOXELS = 128  # along the longest side, at most: what bone hardens is smooth
# Of the densest, what is tried: where soft tissue ends and bone is whole; above 1 where bone is thinner than a voxel.
_BETWEEN = [(soft, bone) for soft in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6) for bone in (0.4, 0.7, 1.0) if soft < bone]
_BETWEEN += [(0.7, 1.0), (0.7, 1.5), (0.8, 1.5)]
_AS_WELL = 0.1  # of what bone explains: with less bone, which does less harm where something else is left
_NEARLY = 1.02  # times what water leaves: whoever states a voltage has a scan that is hardened
_NEWTON = 3  # leave 1e-12
_UNIFORM = 0.08  # of the line integrals' own size: what one material may leave unexplained
_SHADOW = 0.1  # of the longest path
_WATER_TO = 8.0  # largest line integral that the voltage's polynomial is fitted to
_NONE: Polynomial = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class HardeningOptions:
    """polynomial: of p², p³ and p⁴; kvp: tube voltage, kV, whose spectrum is taken; neither: fitted to one material.
    Beside kvp, bone_per_mm: attenuation from which a voxel is bone, 0: tried; filter_mm: of aluminium; anode_deg: angle of a
    tungsten anode, whose spectrum is SpekPy's, 0: Kramers' law."""

    polynomial: Polynomial = _NONE
    kvp: float = 0.0
    bone_per_mm: float = 0.0
    filter_mm: float = FILTER_MM
    anode_deg: float = 0.0

    def __post_init__(self) -> None:
        beside_kvp = {"bone_per_mm": (0, _LARGEST), "filter_mm": (0, 50), "anode_deg": (0, 45)}
        checks.fields_within("hardening.", self, {"polynomial": (-_LARGEST, _LARGEST), **beside_kvp})
        if self.kvp != 0:
            checks.within("hardening.kvp", self.kvp, LOWEST_KVP, HIGHEST_KVP)
        for name in beside_kvp:
            if getattr(self, name) != getattr(type(self), name) and not self.kvp:
                raise InputError(f"hardening.{name}", "given without hardening.kvp", "both, or neither", "state the voltage")
        if self.kvp and any(self.polynomial):
            raise InputError("hardening.kvp", "given with hardening.polynomial", "one of the two", "leave one out")


def straighten(frames: np.ndarray, polynomial: Polynomial) -> np.ndarray:
    """Line integrals p (any shape) as p + a p² + b p³ + c p⁴, float32; below 0 they are air and stay."""
    p = np.asarray(frames, np.float64)
    up = np.maximum(p, 0)
    square, cube, fourth = polynomial
    return (p + up**2 * (square + up * (cube + up * fourth))).astype(np.float32)


def water_polynomial(kvp: float, filter_mm: float = FILTER_MM, anode_deg: float = 0.0) -> Polynomial:
    """The polynomial that makes line integrals of water straight, up to 8, behind a tube as of ``tube_spectrum``."""
    true = np.linspace(0.05, _WATER_TO, 80)
    seen = tube_spectrum(kvp, filter_mm, anode_deg).hardened(true)
    basis = np.stack([seen**2, seen**3, seen**4], axis=1) / true[:, None]
    found = np.linalg.lstsq(basis, (true - seen) / true, rcond=None)[0]
    return float(found[0]), float(found[1]), float(found[2])


def correct_hardening(scan: Scan, options: HardeningOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """The scan with straight line integrals."""
    if options.kvp:
        return _by_voltage(scan, options, make_model)
    frames, fitted = unmasked_frames(scan), not any(options.polynomial)
    polynomial = fit_polynomial(frames, make_model(scan)) if fitted else options.polynomial
    _check_rising(polynomial, float(frames.max()))
    facts = {"polynomial": list(polynomial), "fitted": fitted}
    return replace(scan, projections=straighten(frames, polynomial)), facts


def _check_rising(polynomial: Polynomial, largest: float) -> None:
    """InputError for a polynomial by which more attenuation is less, somewhere up to the ``largest`` line integral."""
    p = np.linspace(0, max(largest, 1e-6), 100)
    falls = np.diff(straighten(p, polynomial)) <= 0
    if falls.any():
        found = f"{list(polynomial)}, which falls from line integrals of {p[np.argmax(falls)]:.3g} on"
        raise InputError("hardening.polynomial", found, f"one that rises up to the largest, {largest:.3g}")


def _by_voltage(scan: Scan, options: HardeningOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    tube = (options.kvp, options.filter_mm, options.anode_deg)
    frames, spectrum, water = unmasked_frames(scan), tube_spectrum(*tube), water_polynomial(*tube)
    facts: Facts = {"kvp": options.kvp}
    bone_in = partial(_from, options.bone_per_mm)
    if not options.bone_per_mm:
        model, blur = coarse_model(scan, make_model)
        mixed, facts["unexplained"] = find_bone(smooth(frames, blur), spectrum, water, model)
        if mixed is None:
            log.warning("hardening: no correction at %g kV explains the frames better: they stay as they are", options.kvp)
            return scan, {**facts, "left_alone": True}
        bone_in = partial(_between, *mixed)
        facts |= dict(zip(("soft_to", "bone_from"), mixed, strict=True)) if np.isfinite(mixed[0]) else {}
    fine = coarse_model(scan, make_model, _BONE_VOXELS)
    clean, facts["bone_share"] = _straighten_two(frames, spectrum, *fine, water, bone_in)
    return replace(scan, projections=clean), facts


def _straighten_two(
    frames: np.ndarray, spectrum: Spectrum, model: Model, blur: float, water: Polynomial, bone_in: BoneIn
) -> tuple[np.ndarray, float]:
    """Line integrals (F, v, u) of soft tissue and bone, straight, and bone's share of the volume's attenuation; those of
    water where no bone is found. blur: pixels, of frames for the model."""
    clean, share = straighten(frames, water), 0.0
    for _ in range(_PASSES):
        volume = model.regularised(smooth(clean, blur))
        bone = bone_in(volume)
        if not bone.any():
            break
        share = float(bone.sum() / np.maximum(volume, 0).sum())
        clean = _with_bone(bone, frames, spectrum, model)
    return clean, share


def find_bone(
    frames: np.ndarray, spectrum: Spectrum, water: Polynomial, model: Model
) -> tuple[tuple[float, float] | None, dict[str, float]]:
    """The shares of the densest up to which all is soft and from which all is bone, with which line integrals (F, v, u)
    explain themselves best: infinity without bone, None where they do best as they are; and what either, and the best with
    bone, leaves unexplained of them. InputError where there is no object."""

    def left_by(clean: np.ndarray) -> float:
        return unexplained(clean, model.volume(clean), inside, model)

    clean = straighten(frames, water)
    first = model.volume(clean)
    if densest(first) <= 0:
        raise _nothing()
    inside = object_in(first)
    none, alone = left_by(frames), left_by(clean)
    volume = model.regularised(clean)
    bones = {pair: _between(*pair, volume) for pair in _BETWEEN}
    left = {pair: left_by(_with_bone(bone, frames, spectrum, model)) for pair, bone in bones.items()}
    least = min(left.values())
    enough = [pair for pair in bones if left[pair] <= least + _AS_WELL * max(alone - least, 0.0)]
    best = min(enough, key=lambda pair: float(bones[pair].sum()))
    told = {"as_they_are": none, "water": alone, "bone": left[best]}
    if left[best] < none and left[best] <= _NEARLY * alone:
        return best, told
    return ((np.inf, np.inf) if alone < none else None), told


def _with_bone(bone: np.ndarray, frames: np.ndarray, spectrum: Spectrum, model: Model) -> np.ndarray:
    """Straight line integrals, where what is ``bone`` (z, y, x) is known."""
    dense = np.maximum(model.frames(bone.astype(np.float32)), 0)
    return (_soft_beside(dense, frames, spectrum) + dense).astype(np.float32)


def _soft_beside(dense: np.ndarray, frames: np.ndarray, spectrum: Spectrum) -> np.ndarray:
    """The soft tissue that, with ``dense`` line integrals of bone, gives what was measured: Newton's method."""
    soft, step = np.asarray(frames - dense, np.float64), 1e-3
    for _ in range(_NEWTON):
        now = spectrum.hardened(soft, dense)
        soft = soft - step * (now - frames) / (spectrum.hardened(soft + step, dense) - now)
    return soft


def fit_polynomial(frames: np.ndarray, model: Model) -> Polynomial:
    """The polynomial for ``straighten``, of p² alone, that line integrals (F, v, u) of one material follow with their path
    through its volume. What the same way makes of straight line integrals of that volume is taken off.

    InputError for an object that is not of one material.
    """
    path, level, bend, left = _bend(frames, model)
    if left > _UNIFORM:
        told = f"{100 * left:.2g} % of the line integrals that the path through one material does not explain"
        remedy = "state hardening.kvp or hardening.polynomial"
        raise InputError("--steps hardening", told, f"at most {100 * _UNIFORM:.2g} %", remedy)
    straight = _bend(path * np.float32(level), model)[2]
    return straight - bend, 0.0, 0.0


def _bend(frames: np.ndarray, model: Model) -> tuple[np.ndarray, float, float, float]:
    """Of line integrals (F, v, u): their path through the object (mm), its attenuation (1/mm), the b of p = t + b t² with t
    in proportion to the path, and the share of them that this leaves unexplained."""
    volume = model.volume(frames)
    level = float(np.median(volume[volume > 0.5 * np.percentile(volume, 99)])) if volume.max() > 0 else 0.0
    path = model.frames(np.clip(volume / max(level, 1e-20), 0, 1).astype(np.float32))
    through = path > _SHADOW * float(path.max())
    if level <= 0 or not through.any():
        raise _nothing()
    length, seen = path[through].astype(np.float64), frames[through].astype(np.float64)
    powers = np.stack([length, length**2], axis=1)
    found = np.linalg.lstsq(powers, seen, rcond=None)[0]
    left = float(np.sqrt(np.mean((seen - powers @ found) ** 2) / np.mean(seen**2)))
    return path, level, float(found[1] / found[0] ** 2), left


def _nothing() -> InputError:
    return InputError("--steps hardening", "nothing in the volume", "an object", "leave the step out")


def _from(bone_per_mm: float, volume: np.ndarray) -> np.ndarray:
    """What is bone where voxels (z, y, x) are one or the other."""
    return np.where(volume >= bone_per_mm, volume, 0)


def _between(soft_to: float, bone_from: float, volume: np.ndarray) -> np.ndarray:
    """What is bone where voxels (z, y, x) mix: none of one that attenuates as soft tissue at most, all of one as bone; both
    as shares of the densest, which the correction makes denser."""
    if soft_to >= bone_from:
        return np.zeros_like(volume)
    soft, bone = soft_to * densest(volume), bone_from * densest(volume)
    return np.clip((volume - soft) * (bone / (bone - soft)), 0, np.maximum(volume, 0))
