"""PhyRadGS: exact radiative splats that know the gantry's motion (the paper's method)."""

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, State, ignore_progress
from phyradgs_cl.reconstructors.splats.method import reconstruct_splats
from phyradgs_cl.reconstructors.splats.options import PRESETS, SplatOptions
from phyradgs_cl.runtime import Runtime


def phyradgs(
    scan: Scan,
    options: SplatOptions,
    rt: Runtime,
    *,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    resume: State | None = None,
    initial: np.ndarray | None = None,
) -> Reconstruction:
    """Reconstructs a scan with M×N micro-views per frame; ``options.motion`` static is the paper's "w/o ST"."""
    return reconstruct_splats(scan, options, rt, seed, report, "phyradgs", resume, initial)


METHOD = Method(phyradgs, PRESETS, is_shared=True, takes_initial=True)
