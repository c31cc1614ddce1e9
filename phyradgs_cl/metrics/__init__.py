"""How close a reconstruction is to the truth."""

from phyradgs_cl.metrics.beads import Bead
from phyradgs_cl.metrics.bias import regional_bias
from phyradgs_cl.metrics.compare import compare
from phyradgs_cl.metrics.edge import edge_sharpness
from phyradgs_cl.metrics.panels import panels_png
from phyradgs_cl.metrics.projections import compare_projections
from phyradgs_cl.metrics.psnr import psnr
from phyradgs_cl.metrics.resample import resampled
from phyradgs_cl.metrics.roundness import roundness
from phyradgs_cl.metrics.slices import slices_png
from phyradgs_cl.metrics.ssim import ssim, ssim_map

__all__ = [
    "Bead",
    "compare",
    "compare_projections",
    "edge_sharpness",
    "panels_png",
    "psnr",
    "regional_bias",
    "resampled",
    "roundness",
    "slices_png",
    "ssim",
    "ssim_map",
]
