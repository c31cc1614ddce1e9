"""How close a reconstruction is to the truth."""

from phyradgs_cl.metrics.align import (
    VOXEL_BY_VOXEL,
    Aligned,
    aligned,
    in_words,
    reference_on,
    resampled,
    shared_slices,
)
from phyradgs_cl.metrics.quality import compare, psnr, ssim, ssim_map
from phyradgs_cl.metrics.slices import slices_png

__all__ = [
    "VOXEL_BY_VOXEL", "Aligned", "aligned", "compare", "in_words", "psnr", "reference_on", "resampled", "shared_slices",
    "slices_png", "ssim", "ssim_map",
]  # fmt: skip
