"""Bias: whether known regions have the right mean, which PSNR mixes with everything else."""

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import at_least, shape
from phyradgs_cl.errors import InputError
from phyradgs_cl.metrics.quality import checked_pair


def regional_bias(
    result: ArrayLike, reference: ArrayLike, labels: ArrayLike, erosion_voxels: int = 1
) -> dict[int, float]:
    """Mean of the result over the mean of the truth, minus 1, in every labelled region.

    Args:
        result: (z, y, x).
        reference: (z, y, x), the truth in the same unit.
        labels: (z, y, x) integers; 0 is no region.
        erosion_voxels: how far regions shrink first, so that blurred edges are not taken for bias.

    Returns:
        label to relative bias. Left out: regions that vanish in erosion, and those whose true mean is 0.

    Raises:
        InputError: shapes that differ, labels that are not integers, NaN or infinity, a negative erosion.
    """
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
    """Erosion by the full 3×3×3 neighbourhood; what lies beyond the volume belongs to no region."""
    if voxels == 0:
        return mask
    return scipy.ndimage.binary_erosion(mask, np.ones((3,) * mask.ndim, bool), iterations=int(voxels))
