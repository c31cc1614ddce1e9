"""How close a reconstruction is to the truth."""

from phyradgs_cl.metrics.compare import compare
from phyradgs_cl.metrics.psnr import psnr
from phyradgs_cl.metrics.resample import resampled, shared_slices
from phyradgs_cl.metrics.slices import slices_png
from phyradgs_cl.metrics.ssim import ssim, ssim_map

__all__ = ["compare", "psnr", "resampled", "shared_slices", "slices_png", "ssim", "ssim_map"]
