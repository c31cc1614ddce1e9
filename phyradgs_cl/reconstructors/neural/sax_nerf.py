"""SAX-NeRF: a neural field with attention along line segments, fitted to scattered rays and windows of rays.

Y. Cai, J. Wang, A. Yuille, Z. Zhou, A. Wang, "Structure-Aware Sparse-View X-ray 3D Reconstruction", CVPR 2024.
"""

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.neural import LineOptions
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.neural.naf import NAF_PUBLISHED
from phyradgs_cl.reconstructors.neural.run import reconstruct_neural
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, State, ignore_progress
from phyradgs_cl.runtime import Runtime

# The released configuration Lineformer/chest_50: that of NAF, with 256 samples for 128 voxels
SAX_PUBLISHED = LineOptions(**{**vars(NAF_PUBLISHED), "samples": 256})
# Windows do not change the expected gradient of a squared error, and of few pixels per step they leave it to noise
SAX_PRESETS = {"default": LineOptions(iterations=50, windows=0), "published": SAX_PUBLISHED}


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


METHOD = Method(sax_nerf, SAX_PRESETS)
