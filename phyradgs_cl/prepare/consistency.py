"""How well line integrals explain themselves: their own volume, projected again, against what they are.

What a grid and few views leave of any object's line integrals is taken off; what is left is of hardening, scatter and the
like, which no volume makes.
"""

import numpy as np
import scipy

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.fields import GridChoice
from phyradgs_cl.prepare.step import MakeModel, Model

_VOXELS = 48  # along the longest side
_INSIDE = 0.1  # of the densest: the object
_SMOOTH = 1 / 24  # of the panel's longer side: such effects are smoother than what a grid cannot hold


def coarse_model(scan: Scan, make_model: MakeModel, most: int = _VOXELS) -> tuple[Model, float]:
    """The scan's model on at most so many voxels along the longest side, and the standard deviation in pixels of the blur
    that frames for it need."""
    finer = max(1.0, max(scan.grid.shape) / most)
    return make_model(scan.with_grid(GridChoice(size=round(max(scan.grid.shape) / finer)))), (finer - 1) / 2


def object_in(volume: np.ndarray) -> np.ndarray:
    """Voxels (z, y, x) of the object and those beside it, bool."""
    return np.asarray(scipy.ndimage.binary_dilation(volume >= _INSIDE * densest(volume)))


def unexplained(frames: np.ndarray, volume: np.ndarray, inside: np.ndarray, model: Model) -> float:
    """The share of line integrals (F, v, u) that what is ``inside`` of their volume leaves, smooth; less what the same way
    leaves of that object's own."""

    def reprojected(whole: np.ndarray) -> np.ndarray:
        return model.frames(np.where(inside, np.maximum(whole, 0), 0).astype(np.float32))

    once = reprojected(volume)
    left = frames - 2 * once + reprojected(model.volume(once))
    left = smooth(left, _SMOOTH * max(frames.shape[1:]))
    return float(np.sqrt(np.mean(left**2) / max(float(np.mean(frames**2)), 1e-20)))


def smooth(frames: np.ndarray, sigma: float) -> np.ndarray:
    """Frames (F, v, u) blurred along v and u by ``sigma`` pixels."""
    return scipy.ndimage.gaussian_filter(frames, (0, sigma, sigma)) if sigma > 0 else frames


def densest(volume: np.ndarray) -> float:
    """The largest value but for one voxel of a thousand, in the middle of a volume (z, y, x)."""
    return float(np.percentile(volume[_measured(volume.shape)], 99.9))


def _measured(shape: tuple[int, ...]) -> np.ndarray:
    """The middle of a volume (z, y, x), where a cone beam's views are complete enough: bool."""
    z, y, x = (np.abs(np.arange(n) - (n - 1) / 2) / max(n / 2, 1) for n in shape)
    return (z[:, None, None] <= 0.6) & (y[None, :, None] ** 2 + x[None, None, :] ** 2 <= 0.9)
