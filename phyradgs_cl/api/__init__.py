"""The toolkit from Python, in the paper's words: scans, reconstructions, and projectors that others can use.

    scan = simulate("foot", size=32)
    result = reconstruct(scan, method="phyradgs", iterations=500)

Everything is documented with runnable examples in docs/api.md. ``device`` is what ``--device`` takes, or a Runtime.
"""

from phyradgs_cl.acquisition import Exact, LineMiddles, MicroViews, Motion, PerRow, Scan, Static, StaticStart
from phyradgs_cl.api.bridges import as_linear_operator, as_torch
from phyradgs_cl.api.calibration import calibrate
from phyradgs_cl.api.projectors import Projector, ray_operator
from phyradgs_cl.api.runs import load_scan, load_volume, reconstruct, save_scan, save_volume, simulate
from phyradgs_cl.calibrate import Calibration
from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import Reconstruction

__all__ = [
    "Calibration",
    "Exact",
    "Gaussians",
    "Grid",
    "LineMiddles",
    "MicroViews",
    "Motion",
    "PerRow",
    "Projector",
    "Reconstruction",
    "Scan",
    "Static",
    "StaticStart",
    "as_linear_operator",
    "as_torch",
    "calibrate",
    "compare",
    "load_scan",
    "load_volume",
    "ray_operator",
    "reconstruct",
    "save_scan",
    "save_volume",
    "simulate",
]
