"""Projections of a volume against held-out ones, at true scale.

The published 2D numbers divide every image by its own maximum, so that they cannot see a wrong gain. Here one range,
the maximum of the whole reference stack, serves all images, and nothing is rescaled.
"""

import numpy as np
from numpy.typing import ArrayLike

from phyradgs_cl.checks import shape
from phyradgs_cl.metrics.quality import checked_pair, psnr, ssim_map


def compare_projections(result: ArrayLike, reference: ArrayLike) -> dict[str, float]:
    """2D PSNR and SSIM of projections against noise-free held-out ones.

    Args:
        result: (F, v, u) line integrals of the reconstruction.
        reference: (F, v, u) line integrals of the truth from the same poses.

    Returns:
        psnr_2d_db over all pixels of all frames; ssim_2d, the mean over pixels and frames (11×11 Gaussian window of
        σ 1.5, zeros beyond the border); data_range_2d, the largest reference value.

    Raises:
        InputError: not 3D, shapes that differ, NaN or infinity, a reference without anything in it.
    """
    a, b, peak = checked_pair(result, reference, None)
    shape("reference", b, (None, None, None))
    frames = [float(ssim_map(x, y, peak).mean()) for x, y in zip(a, b, strict=True)]
    return {"psnr_2d_db": psnr(a, b, peak), "ssim_2d": float(np.mean(frames)), "data_range_2d": peak}
