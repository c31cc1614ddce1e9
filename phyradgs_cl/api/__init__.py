"""The toolkit from Python: scans, reconstructions, and projectors for other packages' algorithms.

    scan = simulate("foot", size=32)
    result = reconstruct(scan, method="phyradgs", iterations=500)

docs/api.md explains everything with runnable examples. Arguments ``device`` are what ``--device`` takes, or a Runtime."""

from phyradgs_cl.acquisition import Centres, ConstantSpeed, SpeedRamp, StaticStart
from phyradgs_cl.acquisition.altered.summed import sum_frames
from phyradgs_cl.acquisition.geometry import ConeGeometry, ParallelGeometry
from phyradgs_cl.acquisition.motion import Exact, LineMiddles, MicroViews, Motion, OwnTimes, PerRow, Static
from phyradgs_cl.acquisition.scan import Scan
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.acquisition.trajectory import CircularOrbit, EncoderTable, FrameSweeps, PoseTable, Trajectory
from phyradgs_cl.api.calibration import calibrate, move_views, pose_gradient
from phyradgs_cl.api.projectors import (
    as_torch,
    initial_gaussians,
    ray_operator,
    splat_operator,
    voxel_operator,
    voxelise,
)
from phyradgs_cl.api.runs import (
    load_deformation,
    load_scan,
    load_volume,
    prepare,
    reconstruct,
    save_deformation,
    save_scan,
    save_volume,
    simulate,
)
from phyradgs_cl.api.scans import fly_scan, static_scan
from phyradgs_cl.calibrate import Calibration
from phyradgs_cl.errors import InputError, PhyradgsError
from phyradgs_cl.fields import Deformation, Gating, Gaussians, Grid, States, deformed
from phyradgs_cl.metrics import compare
from phyradgs_cl.operators.public import LinearOperator, Operator
from phyradgs_cl.reconstructors import Progress, Reconstruction
from phyradgs_cl.simulation import ObjectMotion

__all__ = [
    "Calibration", "Centres", "CircularOrbit", "ConeGeometry", "ConstantSpeed", "Deformation", "EncoderTable",
    "Exact", "FrameSweeps", "Gating", "Gaussians", "Grid", "InputError", "LineMiddles", "LinearOperator", "MicroViews",
    "Motion", "ObjectMotion", "Operator", "OwnTimes", "ParallelGeometry", "PerRow", "PhyradgsError", "PoseTable", "Progress",
    "Reconstruction", "Scan", "Shutter", "SpeedRamp", "States", "Static", "StaticStart", "TimeCells", "Trajectory",
    "as_torch", "calibrate", "compare", "deformed", "fly_scan", "initial_gaussians", "load_deformation", "load_scan",
    "load_volume", "move_views", "pose_gradient", "prepare", "ray_operator", "reconstruct", "save_deformation",
    "save_scan", "save_volume", "simulate", "splat_operator", "static_scan", "sum_frames", "voxel_operator", "voxelise",
]  # fmt: skip
