"""Compares projections of a volume with held-out ones, at true scale.

The published 2D numbers divide every image by its own maximum, so they cannot show a wrong gain. Here all images have one
range, the maximum of the whole reference stack, and nothing is rescaled."""

import numpy as np
from numpy.typing import ArrayLike

from phyradgs_cl.metrics.quality import checked_pair, psnr, ssim_map


def compare_projections(result: ArrayLike, reference: ArrayLike) -> dict[str, float]:
    """Returns 2D PSNR and SSIM of projections against noise-free held-out ones, both (F, v, u) line integrals.

    psnr_2d_db is over all pixels of all frames. ssim_2d is the mean over pixels and frames (11×11 Gaussian window of σ 1.5,
    zeros beyond the border). data_range_2d is the largest reference value."""
    a, b, peak = checked_pair(result, reference, None)
    frames = [float(ssim_map(x, y, peak).mean()) for x, y in zip(a, b, strict=True)]
    return {"psnr_2d_db": psnr(a, b, peak), "ssim_2d": float(np.mean(frames)), "data_range_2d": peak}
