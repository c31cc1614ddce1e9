"""What a run over several ranks takes, by counting and without a trial: what lies where, bytes a rank, bytes exchanged.

Bytes on a device are those of the iterations. The first volume before them and the last one after them take what room there
is, in bricks. Bytes exchanged are what a rank hands to MPI; on the wire a ring sends 2 (R − 1) / R of that.
"""

from __future__ import annotations

from typing import Any

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.rank_plan.load import Load, RankPlan
from phyradgs_cl.rank_plan.splats import SplatPlan
from phyradgs_cl.rank_plan.voxels import voxel_plan
from phyradgs_cl.reconstructors import METHODS
from phyradgs_cl.reconstructors.splat_options import SplatOptions

__all__ = ["Load", "RankPlan", "plan_ranks"]


def plan_ranks(scan: Scan, method: str, options: Any, ranks: int) -> RankPlan:
    """The plan of a run of ``method`` on ``ranks`` ranks. Raises InputError where they have no part in it."""
    if not METHODS[method].is_shared:
        sharing = ", ".join(name for name, one in METHODS.items() if one.is_shared)
        raise InputError(f"--method {method}", f"{ranks} ranks", f"one of {sharing}", "leave --ranks out")
    if isinstance(options, SplatOptions):
        return SplatPlan(scan, options, ranks).plan(method)
    return voxel_plan(scan, method, options, ranks)
