"""How a scan is acquired: geometry, trajectory, shutter, motion models with their time cells, and the scan itself."""

from phyradgs_cl.acquisition.geometry import ConeGeometry, ParallelGeometry, pixel_centres, transpose_pose
from phyradgs_cl.acquisition.motion import (
    MOTIONS,
    Centres,
    Exact,
    LineMiddles,
    MicroViews,
    Motion,
    OwnTimes,
    PerRow,
    Static,
    StaticStart,
)
from phyradgs_cl.acquisition.protocol import PROTOCOLS, Protocol, make_protocol
from phyradgs_cl.acquisition.scan import Saturation, Scan
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.acquisition.trajectory import (
    CircularOrbit,
    ConstantSpeed,
    EncoderTable,
    FrameSweeps,
    PoseTable,
    SpeedRamp,
    Trajectory,
)

__all__ = [
    "MOTIONS", "PROTOCOLS", "Centres", "ParallelGeometry", "CircularOrbit", "ConeGeometry", "ConstantSpeed", "EncoderTable",
    "Exact", "FrameSweeps", "LineMiddles", "MicroViews", "Motion", "OwnTimes", "PerRow", "PoseTable",
    "Protocol", "Saturation", "Scan", "Shutter", "SpeedRamp", "Static", "StaticStart", "TimeCells",
    "Trajectory", "make_protocol", "pixel_centres", "transpose_pose"
]  # fmt: skip
