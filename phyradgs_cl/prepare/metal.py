"""Masks rays through metal for iterative methods, fills the metal's shadow for FDK, and returns the metal's voxels for the
finished volume (Kalender, Hebel and Ebersberger, Radiology 164 (1987) 576)."""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Metal
from phyradgs_cl.prepare import step
from phyradgs_cl.prepare.step import Facts, MakeModel, StepOptions

_DENSER = 6.0  # metal has at least 6 times the main material's attenuation; bone has up to 5 times water's, titanium 7
_FEWEST = 4  # fewer touching voxels than this are noise, not metal
_BLIND = 2  # voxels up to this many voxels from metal are filled from outside: all rays through them are masked
_VOXELS = 128  # the volume that fills the shadow has at most this many voxels along its longest side, to save time
_MOST, _OBJECT = 0.5, 0.02  # the shadow may cover at most half of the pixels that exceed 0.02 of the frames' largest value


@dataclass(frozen=True)
class MetalOptions(StepOptions, step="metal"):
    """Options of the step ``metal``. above_per_mm: attenuation in 1/mm from which voxels of a first volume are metal; 0: six
    times that of the main material."""

    above_per_mm: float = checks.ranged(0.0, 0, 1e3)


def mask_metal(scan: Scan, options: MetalOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """Returns the scan with the shadow of metal masked and filled, and with the metal's voxels. Returns a scan without metal
    unchanged. Raises InputError where the shadow covers most of the object."""
    model = make_model(scan)
    frames = step.unmasked_frames(scan)
    volume = model.volume(frames)
    above = options.above_per_mm or _DENSER * _main_level(volume)
    labels, _ = scipy.ndimage.label(volume >= above)
    is_metal = (np.bincount(labels.ravel()) >= _FEWEST)[labels] & (labels > 0)
    facts: Facts = {"above_per_mm": above, "voxels": int(is_metal.sum())}
    if not is_metal.any():
        return scan, {**facts, "result": "nothing to do"}
    shadow = model.shadow(is_metal)
    facts["shadow_share"] = share = float(shadow[frames > _OBJECT * frames.max()].mean())
    if share > _MOST:
        found = f"{is_metal.sum()} voxels from {above:.4g} 1/mm on, whose shadow covers {100 * share:.0f} % of the object"
        remedy = "state a larger --set metal.above_per_mm, or leave the step out"
        raise InputError("--steps metal", found, f"at most {100 * _MOST:.0f} %", remedy)
    metal = Metal(np.where(is_metal, volume, 0).astype(np.float32), scan.grid)
    masked = step.with_masked(scan, shadow)
    return replace(masked, projections=_completed(masked, shadow, is_metal, make_model), metal=metal), facts


def _completed(masked: Scan, shadow: np.ndarray, is_metal: np.ndarray, make_model: MakeModel) -> np.ndarray:
    """Returns the frames (F, v, u) with the shadow filled by the projection of a volume, reconstructed from the other
    pixels. The projection's difference from the frames at the shadow's rim is interpolated across the shadow: no edge shows.

    Only masked rays meet the voxels in and next to metal. These voxels would stay near 0, so they get the density around."""
    model, _ = step.coarse_model(masked, make_model, _VOXELS)
    volume = model.regularised(masked.projections)
    factors = np.divide(volume.shape, is_metal.shape)
    blind = scipy.ndimage.zoom(is_metal.astype(np.float32), factors, order=1, mode="nearest", grid_mode=True) > 0
    blind = scipy.ndimage.binary_dilation(blind, iterations=_BLIND)
    nearest = scipy.ndimage.distance_transform_edt(blind, return_distances=False, return_indices=True)
    volume = np.where(blind, scipy.ndimage.median_filter(volume, 3)[tuple(nearest)], volume)
    computed = model.frames(volume)
    missed = step.fill_masked(masked.projections - computed, shadow)
    return np.where(shadow, computed + missed, masked.projections).astype(np.float32)


def _main_level(volume: np.ndarray) -> float:
    """Returns the main material's attenuation in a volume (z, y, x): voxels above it make up half of the total attenuation.
    Infinity if no voxel is above 0."""
    rising = np.sort(volume[volume > 0])
    if rising.size == 0:
        return float("inf")
    total = np.cumsum(rising, dtype=np.float64)
    return float(rising[np.searchsorted(total, total[-1] / 2)])
