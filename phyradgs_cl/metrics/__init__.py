"""Compares a reconstruction, and its error bars, with the true volume."""

from phyradgs_cl.metrics.align import (
    VOXEL_BY_VOXEL,
    Aligned,
    aligned,
    in_words,
    overlap,
    reference_on,
    resampled,
    shared_slices,
)
from phyradgs_cl.metrics.coverage import COVERAGE, coverage, reliability_png
from phyradgs_cl.metrics.quality import (
    HELD_OUT,
    METRICS,
    compare,
    edge_points_mm,
    motion_error_mm,
    printed,
    psnr,
    slices_png,
    ssim,
    ssim_map,
)

__all__ = [
    "COVERAGE", "HELD_OUT", "METRICS", "VOXEL_BY_VOXEL", "Aligned", "aligned", "compare", "coverage", "edge_points_mm",
    "in_words", "motion_error_mm", "overlap", "printed", "psnr", "reference_on", "reliability_png", "resampled",
    "shared_slices", "slices_png", "ssim", "ssim_map",
]  # fmt: skip
