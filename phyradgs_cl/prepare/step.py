"""What preparation steps share: their type, interpolation of masked pixels, comparison of a scan with its reprojection."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.fields import GridChoice

Facts = dict[str, Any]
"""What a step did, as numbers and words by name, for the scan's provenance."""
_COARSE_VOXELS = 48  # most voxels along the longest side of a coarse model: few suffice, as hardening and scatter are smooth
_INSIDE = 0.1  # voxels above this fraction of the densest voxel belong to the object
# Standard deviation of a blur, as a fraction of the panel's longer side: the blur keeps the smooth errors of hardening and
# scatter, and removes the finer errors of the grid.
_SMOOTH = 1 / 24


class StepOptions(checks.Checked):
    """Base of the options of the step that ``step`` names. Messages call an option STEP.NAME."""

    def __init_subclass__(cls, step: str) -> None:
        cls.PREFIX = f"{step}."


@dataclass(frozen=True)
class Model:
    """Reconstructs a scan and projects the volume again, on the scan's grid: for steps that need to know the object.

    volume: reconstructs frames (F, v, u) to a volume (z, y, x) in 1/mm. frames: projects a volume. regularised: reconstructs
    more slowly, with a weak total-variation prior. shadow: returns the pixels, bool (F, v, u), whose rays meet given voxels,
    bool (z, y, x), at any time of the exposure."""

    volume: Callable[[np.ndarray], np.ndarray]
    frames: Callable[[np.ndarray], np.ndarray]
    regularised: Callable[[np.ndarray], np.ndarray]
    shadow: Callable[[np.ndarray], np.ndarray]


MakeModel = Callable[[Scan], Model]
Step = Callable[[Scan, Any, MakeModel], tuple[Scan, Facts]]  # (scan, the step's own options, make_model) to (scan, facts)


def unmasked_frames(scan: Scan) -> np.ndarray:
    """Returns line integrals (F, v, u) with masked pixels interpolated, unless the step metal has filled them already."""
    is_filled = scan.pixel_mask is None or scan.metal is not None
    return scan.projections if is_filled else fill_masked(scan.projections, ~scan.valid)


def fill_masked(frames: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Returns frames (F, v, u) with masked pixels interpolated linearly along their row. A row without valid pixels is
    interpolated between the nearest rows that have some; a frame without valid pixels becomes 0."""
    filled = frames.copy()
    empty: np.ndarray = np.asarray(mask.all(axis=-1))
    for f, v in zip(*np.nonzero(mask.any(axis=-1) & ~empty), strict=True):
        bad = mask[f, v]
        good = np.flatnonzero(~bad)
        filled[f, v, bad] = np.interp(np.flatnonzero(bad), good, filled[f, v, good])
    for f in np.flatnonzero(empty.any(axis=-1)):
        filled[f, empty[f]] = 0.0
        fill_lines(filled[f], empty[f])
    return filled


def fill_lines(lines: np.ndarray, bad: np.ndarray) -> None:
    """Interpolates the ``bad`` lines, bool (n,), of lines (n, k) in place, from the nearest others; if there are any."""
    if bad.any() and not bad.all():
        good = np.flatnonzero(~bad)
        at = np.interp(np.flatnonzero(bad), good, np.arange(len(good)))
        low, share = np.floor(at).astype(int), (at - np.floor(at))[:, None]
        high = np.minimum(low + 1, len(good) - 1)
        lines[bad] = (1 - share) * lines[good[low]] + share * lines[good[high]]


def with_masked(scan: Scan, bad: np.ndarray) -> Scan:
    """Returns the scan with the pixels ``bad``, bool (v, u) or (F, v, u), masked and interpolated too."""
    if not bad.any():
        return scan
    mask = bad if scan.pixel_mask is None else (np.asarray(scan.pixel_mask) != 0) | bad
    unfilled = mask if scan.metal is None else bad
    filled = fill_masked(scan.projections, np.broadcast_to(unfilled, scan.projections.shape))
    return replace(scan, pixel_mask=mask, projections=filled)


def coarse_model(scan: Scan, make_model: MakeModel, most: int = _COARSE_VOXELS) -> tuple[Model, float]:
    """Returns the scan's model on at most ``most`` voxels along the longest side, and the standard deviation in pixels by
    which frames must be blurred to fit it."""
    factor = max(1.0, max(scan.grid.shape) / most)
    return make_model(scan.with_grid(GridChoice(size=round(max(scan.grid.shape) / factor)))), (factor - 1) / 2


def smooth(frames: np.ndarray, sigma: float) -> np.ndarray:
    """Returns frames (F, v, u) blurred along v and u by a Gaussian of ``sigma`` pixels."""
    return scipy.ndimage.gaussian_filter(frames, (0, sigma, sigma)) if sigma > 0 else frames


def object_in(volume: np.ndarray) -> np.ndarray:
    """Returns the voxels of the object and their neighbours, bool (z, y, x)."""
    return np.asarray(scipy.ndimage.binary_dilation(volume >= _INSIDE * densest(volume)))


def densest(volume: np.ndarray) -> float:
    """Returns the 99.9th percentile in the middle of a volume (z, y, x), since a cone beam sees its ends only in part."""
    z, y, x = (np.abs(np.arange(n) - (n - 1) / 2) / max(n / 2, 1) for n in volume.shape)
    middle = (z[:, None, None] <= 0.6) & (y[None, :, None] ** 2 + x[None, None, :] ** 2 <= 0.9)
    return float(np.percentile(volume[middle], 99.9))


def unexplained(frames: np.ndarray, volume: np.ndarray, inside: np.ndarray, model: Model) -> float:
    """Returns the RMS of the blurred difference between line integrals (F, v, u) and the projection of their ``volume``,
    divided by the line integrals' RMS.

    Only voxels ``inside`` the object, bool (z, y, x), are projected. The grid and the number of views cause a difference
    too. This part is measured by reconstructing and projecting the projection itself, and subtracted. What remains comes
    from hardening, scatter and the like."""

    def reprojected(values: np.ndarray) -> np.ndarray:
        return model.frames(np.where(inside, np.maximum(values, 0), 0).astype(np.float32))

    once = reprojected(volume)
    residual = frames - 2 * once + reprojected(model.volume(once))
    residual = smooth(residual, _SMOOTH * max(frames.shape[1:]))
    return float(np.sqrt(np.mean(residual**2) / max(float(np.mean(frames**2)), 1e-20)))
