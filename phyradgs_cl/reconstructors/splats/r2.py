"""R2-Gaussian (Zha et al. 2024): affine radiative splats with the published constants, static by default.

Micro-views as motion are the paper's "R2 w/ ST".
"""

from dataclasses import replace
from typing import Any

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import Reconstruction
from phyradgs_cl.reconstructors.splats.method import reconstruct_splats
from phyradgs_cl.reconstructors.splats.options import R2_PUBLISHED, SplatOptions
from phyradgs_cl.runtime import Runtime


def _run(scan: Scan, options: SplatOptions, rt: Runtime, **given: Any) -> Reconstruction:
    return reconstruct_splats(scan, replace(options, affine=True), rt, method="r2", **given)


METHOD = Method(_run, {"published": R2_PUBLISHED}, is_shared=True, takes_initial=True)
