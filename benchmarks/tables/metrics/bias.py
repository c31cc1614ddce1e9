"""Bias: whether known regions have the right mean, which PSNR does not separate from other errors."""

import numpy as np
import scipy


def regional_bias(result: np.ndarray, reference: np.ndarray, labels: np.ndarray) -> dict[int, float]:
    """Returns by label the mean of the result over the mean of the truth, minus 1.

    result, reference: (z, y, x) in one unit. labels: (z, y, x) integers; 0 is no region. Regions shrink by a voxel before,
    so that blurred edges do not count as bias. Regions that vanish, and those whose true mean is 0, are left out."""
    found: dict[int, float] = {}
    for label in np.unique(labels[labels != 0]):
        inner = scipy.ndimage.binary_erosion(labels == label, np.ones((3, 3, 3), bool))
        true_mean = float(reference[inner].mean(dtype=np.float64)) if inner.any() else 0.0
        if true_mean != 0:
            found[int(label)] = float(result[inner].mean(dtype=np.float64)) / true_mean - 1
    return found
