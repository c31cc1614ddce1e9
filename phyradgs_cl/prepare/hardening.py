"""Beam hardening undone: line integrals as they are in the thinnest layer.

By a polynomial that was measured with a wedge. Or by the tube's voltage: what is bone in the scan's own volume is
reprojected, and the spectrum says what soft tissue is left (Joseph and Spital, J. Comput. Assist. Tomogr. 2 (1978) 100),
again as the volume gets better. Or, of an object of one material, by the scan's consistency with its own reprojection: how
line integrals grow with the path through the segmented volume says the polynomial (Krumm, Kasperl and Franz, NDT & E Int. 41
(2008) 242).
"""

from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import Spectrum, tube_spectrum
from phyradgs_cl.detector.spectrum import HIGHEST_KVP, LOWEST_KVP
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.masked import unmasked_frames
from phyradgs_cl.prepare.step import Facts, MakeModel, Model

Polynomial = tuple[float, float, float]
_LARGEST = 1e3
_DENSE = 1.5  # times the mean of what is soft: from here the densest class is another material
_LEAST_SHARE = 1e-3  # of the object: a material of less cannot be fitted
_PASSES = 3  # of bone from volume from bone
_NEWTON = 8
_UNIFORM = 0.08  # of the line integrals' own size: what one material may leave unexplained
_SHADOW = 0.1  # of the longest path
_WATER_TO = 8.0  # largest line integral that the voltage's polynomial is fitted to
_NONE: Polynomial = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class HardeningOptions:
    """polynomial: of p², p³ and p⁴; kvp: tube voltage, kV, whose spectrum is taken; neither: fitted to one material.
    bone_per_mm: attenuation from which a voxel is bone, beside kvp; 0: where the volume's values part by themselves."""

    polynomial: Polynomial = _NONE
    kvp: float = 0.0
    bone_per_mm: float = 0.0

    def __post_init__(self) -> None:
        checks.fields_within("hardening.", self, {"polynomial": (-_LARGEST, _LARGEST)})
        if self.kvp != 0:
            checks.within("hardening.kvp", self.kvp, LOWEST_KVP, HIGHEST_KVP)
        checks.within("hardening.bone_per_mm", self.bone_per_mm, 0, _LARGEST)
        if self.bone_per_mm and not self.kvp:
            raise InputError("hardening.bone_per_mm", "given without hardening.kvp", "both, or neither", "state the voltage")
        if self.kvp and any(self.polynomial):
            raise InputError("hardening.kvp", "given with hardening.polynomial", "one of the two", "leave one out")


def straighten(frames: np.ndarray, polynomial: Polynomial) -> np.ndarray:
    """Line integrals p (any shape) as p + a p² + b p³ + c p⁴, float32; below 0 they are air and stay."""
    p = np.asarray(frames, np.float64)
    up = np.maximum(p, 0)
    square, cube, fourth = polynomial
    return (p + up**2 * (square + up * (cube + up * fourth))).astype(np.float32)


def water_polynomial(kvp: float) -> Polynomial:
    """The polynomial that makes line integrals of water straight, up to 8, behind a tube at ``kvp`` kV."""
    true = np.linspace(0.05, _WATER_TO, 80)
    seen = tube_spectrum(kvp).hardened(true)
    basis = np.stack([seen**2, seen**3, seen**4], axis=1) / true[:, None]
    found = np.linalg.lstsq(basis, (true - seen) / true, rcond=None)[0]
    return float(found[0]), float(found[1]), float(found[2])


def correct_hardening(scan: Scan, options: HardeningOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """The scan with straight line integrals."""
    frames = unmasked_frames(scan)
    if options.kvp:
        spectrum, water = tube_spectrum(options.kvp), water_polynomial(options.kvp)
        clean, bone = straighten_two(frames, spectrum, make_model(scan), water, options.bone_per_mm)
        return replace(scan, projections=clean), {"kvp": options.kvp, "bone_share": bone}
    fitted = not any(options.polynomial)
    polynomial = fit_polynomial(frames, make_model(scan)) if fitted else options.polynomial
    facts = {"polynomial": list(polynomial), "fitted": fitted}
    return replace(scan, projections=straighten(frames, polynomial)), facts


def straighten_two(
    frames: np.ndarray, spectrum: Spectrum, model: Model, water: Polynomial, bone_per_mm: float = 0.0
) -> tuple[np.ndarray, float]:
    """Line integrals (F, v, u) of soft tissue and bone, straight, and bone's share of the object's voxels; those of water
    where no bone is found. ``bone_per_mm``: as of ``HardeningOptions``."""
    clean, share = straighten(frames, water), 0.0
    for _ in range(_PASSES):
        volume = model.volume(clean)
        masks = _materials(volume, bone_per_mm)
        if masks is None or masks[1] is None:
            break
        bone = masks[1]
        share = float(bone.sum() / max(masks[0].sum(), 1))
        dense = np.maximum(model.frames(np.where(bone, volume, 0).astype(np.float32)), 0)
        clean = (_soft_beside(dense, frames, spectrum) + dense).astype(np.float32)
    return clean, share


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
        raise InputError("--steps hardening", "nothing in the volume", "an object", "leave the step out")
    length, seen = path[through].astype(np.float64), frames[through].astype(np.float64)
    powers = np.stack([length, length**2], axis=1)
    found = np.linalg.lstsq(powers, seen, rcond=None)[0]
    left = float(np.sqrt(np.mean((seen - powers @ found) ** 2) / np.mean(seen**2)))
    return path, level, float(found[1] / found[0] ** 2), left


def _materials(volume: np.ndarray, bone_per_mm: float = 0.0) -> tuple[np.ndarray, np.ndarray | None] | None:
    """The object and, if there is any, what is bone in it (z, y, x) bool, from ``bone_per_mm`` on if that is not 0; None
    where nothing stands out."""
    from skimage.filters import threshold_multiotsu  # slow to import

    values = volume[_measured(volume.shape)]
    if np.ptp(values) == 0:
        return None
    low, high = threshold_multiotsu(values, classes=3)
    inside, dense = volume >= low, volume >= (bone_per_mm or high)
    if bone_per_mm:
        return inside, dense if dense.any() else None
    soft = inside & ~dense
    many = dense.sum() > _LEAST_SHARE * inside.sum() and soft.any()
    has_bone = bool(many and volume[dense].mean() > _DENSE * volume[soft].mean())
    return inside, dense if has_bone else None


def _measured(shape: tuple[int, ...]) -> np.ndarray:
    """The middle of a volume (z, y, x), where a cone beam's views are complete enough: bool."""
    z, y, x = (np.abs(np.arange(n) - (n - 1) / 2) / max(n / 2, 1) for n in shape)
    return (z[:, None, None] <= 0.6) & (y[None, :, None] ** 2 + x[None, None, :] ** 2 <= 0.9)
