"""SAX-NeRF: a neural field with attention along line segments, fitted to scattered rays and windows of rays.

Y. Cai, J. Wang, A. Yuille, Z. Zhou, A. Wang, "Structure-Aware Sparse-View X-ray 3D Reconstruction", CVPR 2024.
"""

from __future__ import annotations

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.neural import LineOptions
from phyradgs_cl.reconstructors.neural_run import reconstruct_neural
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, State, ignore_progress
from phyradgs_cl.runtime import Runtime

# The released configuration Lineformer/chest_50
SAX_PUBLISHED = LineOptions(
    iterations=1500,
    rays=1024,
    samples=256,
    jitter="sample",
    positive_only=True,
    voxel_points=1,
    levels=16,
    base_resolution=16,
    table_log2=19,
    density_bound=1.0,
    first_share=0.5,
    rate=1e-3,
    rate_factor=0.1,
    rate_step=1500,
)
SAX_PRESETS = {"default": LineOptions(rays=128, windows=2), "published": SAX_PUBLISHED}


def sax_nerf(
    scan: Scan,
    options: LineOptions,
    rt: Runtime,
    *,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    resume: State | None = None,
) -> Reconstruction:
    """The volume (nz, ny, nx) in 1/mm of a neural field; the seed draws first parameters, frames, pixels and samples."""
    return reconstruct_neural(scan, options, rt, seed, report, "sax-nerf", resume)
