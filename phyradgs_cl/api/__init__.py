"""The toolkit from Python, in the paper's words: scans, reconstructions, and projectors that others can use.

    scan = simulate("foot", size=32)
    result = reconstruct(scan, method="phyradgs", iterations=500)

Everything is documented with runnable examples in docs/api.md. ``device`` is what ``--device`` takes, or a Runtime.
"""

from phyradgs_cl.acquisition import Exact, LineMiddles, MicroViews, Motion, PerRow, Scan, Static, StaticStart
from phyradgs_cl.api.bridges import as_linear_operator, as_torch
from phyradgs_cl.api.projectors import Projector, ray_operator
from phyradgs_cl.api.runs import (
    load_scan,
    load_volume,
    prepare,
    reconstruct,
    save_scan,
    save_volume,
    simulate,
)
from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.metrics import compare
from phyradgs_cl.prepare import (
    find_air,
    find_dead,
    find_sparks,
    fit_scatter,
    remove_scatter,
    ring_pattern,
    sort_rings,
    straighten,
    water_polynomial,
)
from phyradgs_cl.reconstructors import Reconstruction

__all__ = [
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
    "compare",
    "find_air",
    "find_dead",
    "find_sparks",
    "fit_scatter",
    "load_scan",
    "load_volume",
    "prepare",
    "ray_operator",
    "reconstruct",
    "remove_scatter",
    "ring_pattern",
    "save_scan",
    "save_volume",
    "simulate",
    "sort_rings",
    "straighten",
    "water_polynomial",
]
