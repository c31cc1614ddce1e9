"""Bias: whether known regions have the right mean, which PSNR does not separate from other errors."""

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import at_least, shape
from phyradgs_cl.errors import InputError
from phyradgs_cl.metrics.quality import checked_pair


def regional_bias(
    result: ArrayLike, reference: ArrayLike, labels: ArrayLike, erosion_voxels: int = 1
) -> dict[int, float]:
    """Returns by label the mean of the result over the mean of the truth, minus 1.

    result, reference: (z, y, x) in one unit. labels: (z, y, x) integers; 0 is no region. erosion_voxels: by how much regions
    shrink before, so that blurred edges do not count as bias. Regions that vanish in erosion, and those whose true mean is
    0, are left out. Raises InputError for shapes that differ, labels that are no integers, NaN or infinity, and negative
    erosion."""
    a, b, _ = checked_pair(result, reference, 1.0)
    regions = np.asarray(labels)
    shape("labels", regions, b.shape)
    at_least("erosion_voxels", erosion_voxels, 0)
    if regions.dtype.kind not in "iub":
        raise InputError("labels", f"type {regions.dtype}", "integers")
    found: dict[int, float] = {}
    for label in np.unique(regions[regions != 0]):
        inner = _eroded(regions == label, erosion_voxels)
        true_mean = float(b[inner].mean(dtype=np.float64)) if inner.any() else 0.0
        if true_mean != 0:
            found[int(label)] = float(a[inner].mean(dtype=np.float64)) / true_mean - 1
    return found


def _eroded(mask: NDArray[np.bool_], voxels: int) -> NDArray[np.bool_]:
    """Returns the mask eroded by the full 3×3×3 neighbourhood. Voxels beyond the volume belong to no region."""
    if voxels == 0:
        return mask
    return scipy.ndimage.binary_erosion(mask, np.ones((3,) * mask.ndim, bool), iterations=int(voxels))
