"""R2-Gaussian (Zha et al. 2024): affine radiative splats with the published constants, static by default."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, State, ignore_progress
from phyradgs_cl.reconstructors.splats.method import reconstruct_splats
from phyradgs_cl.reconstructors.splats.options import R2_PUBLISHED, SplatOptions
from phyradgs_cl.runtime import Runtime


def r2(
    scan: Scan,
    options: SplatOptions,
    rt: Runtime,
    *,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    resume: State | None = None,
    initial: np.ndarray | None = None,
) -> Reconstruction:
    """Reconstructs a scan with R2-Gaussian's splat; micro-views as motion are the paper's "R2 w/ ST"."""
    return reconstruct_splats(scan, replace(options, affine=True), rt, seed, report, "r2", resume, initial)


METHOD = Method(r2, {"published": R2_PUBLISHED}, is_shared=True, takes_initial=True)
