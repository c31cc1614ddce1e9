"""Beam hardening undone by a polynomial in the line integrals, its first coefficient 1: right in the thinnest layer.

The polynomial is stated (as measured with a wedge), follows for water from the tube's voltage, or is the one whose volume is
most uniform in each of the materials that its own segmentation shows: air, soft and, with a second line integral reprojected
from what is bone, bone. Kyriakou, Meyer, Prell and Kachelrieß, Med. Phys. 37 (2010) 5179, where a person judges uniformity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import tube_spectrum
from phyradgs_cl.detector.spectrum import HIGHEST_KVP, LOWEST_KVP
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.masked import unmasked_frames
from phyradgs_cl.prepare.step import Facts, MakeModel, Model

Polynomial = tuple[float, float, float]
_LARGEST = 1e3
_DENSE = 1.5  # times the mean of what is soft: from here the densest class is another material
_LEAST_SHARE = 1e-3  # of the object: a material of less cannot be fitted
_RIDGE = 1e-4
_WATER_TO = 8.0  # largest line integral that the voltage's polynomial is fitted to
_BALL = np.ones((3, 3, 3), bool)
_NONE: Polynomial = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class HardeningOptions:
    """polynomial: of p², p³ and p⁴; kvp: tube voltage, kV, whose polynomial for water is taken; neither: fitted."""

    polynomial: Polynomial = _NONE
    kvp: float = 0.0

    def __post_init__(self) -> None:
        checks.fields_within("hardening.", self, {"polynomial": (-_LARGEST, _LARGEST)})
        if self.kvp != 0:
            checks.within("hardening.kvp", self.kvp, LOWEST_KVP, HIGHEST_KVP)
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
    if options.kvp or any(options.polynomial):
        polynomial = options.polynomial if any(options.polynomial) else water_polynomial(options.kvp)
        return replace(scan, projections=straighten(frames, polynomial)), {"polynomial": list(polynomial)}
    clean, facts = fit_hardening(frames, make_model(scan))
    return replace(scan, projections=clean), facts


def fit_hardening(frames: np.ndarray, model: Model) -> tuple[np.ndarray, Facts]:
    """Line integrals (F, v, u) corrected so that their volume is uniform per material, and the coefficients that do it: of p²,
    p³ and, with bone's own line integral q where there is bone, of p q and q²."""
    p = np.maximum(frames, 0)
    first = model.volume(frames)
    masks = _materials(first)
    if masks is None:
        return frames, {"coefficients": [], "bone": False}
    air, soft, bone = masks
    terms = [p**2, p**3]
    if bone is not None:
        q = model.frames(np.where(bone, first, 0).astype(np.float32))
        terms += [p * q, q**2]
    regions = [air, *(scipy.ndimage.binary_erosion(m, _BALL) for m in (soft, bone) if m is not None)]
    regions = [regions[0], *(region for region in regions[1:] if region.any())]
    wanted = _deviations(first, regions)
    basis = np.stack([_deviations(model.volume(term), regions) for term in terms], axis=1)
    scale = np.linalg.norm(basis, axis=0)
    scale[scale == 0] = 1
    matrix = basis / scale
    normal = matrix.T @ matrix + _RIDGE * np.eye(len(terms))
    found = -np.linalg.solve(normal, matrix.T @ wanted) / scale
    left = float(np.linalg.norm(wanted + basis @ found) / max(np.linalg.norm(wanted), 1e-20))
    clean = frames + sum(np.float32(c) * term for c, term in zip(found, terms, strict=True))
    facts = {"coefficients": [float(c) for c in found], "bone": bone is not None, "deviation_left": left}
    return clean.astype(np.float32), facts


def _materials(volume: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None] | None:
    """Air, soft and, if there is any, bone (z, y, x) bool in the middle of a volume; None where nothing stands out."""
    from skimage.filters import threshold_multiotsu  # slow to import

    inside = _measured(volume.shape)
    values = volume[inside]
    if np.ptp(values) == 0:
        return None
    low, high = threshold_multiotsu(values, classes=3)
    middle, dense = volume[inside & (volume >= low) & (volume < high)], inside & (volume >= high)
    object_ = inside & (volume >= low)
    many = dense.sum() > _LEAST_SHARE * object_.sum()
    has_bone = bool(many and volume[dense].mean() > _DENSE * middle.mean())
    air = inside & ~scipy.ndimage.binary_dilation(volume >= 0.5 * low, _BALL, iterations=2)
    return air, object_ & ~dense if has_bone else object_, dense if has_bone else None


def _measured(shape: tuple[int, ...]) -> np.ndarray:
    """The middle of a volume (z, y, x), where a cone beam's views are complete enough: bool."""
    z, y, x = (np.abs(np.arange(n) - (n - 1) / 2) / max(n / 2, 1) for n in shape)
    return (z[:, None, None] <= 0.6) & (y[None, :, None] ** 2 + x[None, None, :] ** 2 <= 0.9)


def _deviations(volume: np.ndarray, regions: list[np.ndarray]) -> np.ndarray:
    """What a volume (z, y, x) is off 0 in the first region and off the mean in each of the others, (n,) float64."""
    values = [volume[region].astype(np.float64) for region in regions]
    return np.concatenate([values[0], *(v - v.mean() for v in values[1:])])
