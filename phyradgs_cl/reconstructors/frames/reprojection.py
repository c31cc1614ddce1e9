"""A scan's own reconstruction and reprojection, for steps that compare frames with what they say of the object."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import LineMiddles, PerRow, Scan
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.prepare import Model
from phyradgs_cl.reconstructors.fdk import FdkOptions, fdk
from phyradgs_cl.reconstructors.voxels import fista_tv
from phyradgs_cl.reconstructors.voxels.fista_tv import FistaTvOptions
from phyradgs_cl.runtime import Runtime

_LITTLE_VARIATION = FistaTvOptions(motion=PerRow(sub_intervals=2), iterations=30, tv_weight=0.002)


def reprojection(rt: Runtime, scan: Scan) -> Model:
    """FDK with every line at the middle of its own exposure, and rays at the same times, on the scan's grid."""
    motion = LineMiddles()
    options = FdkOptions(window="hann", motion=motion)
    tables = [motion.cells(scan, frame).still() for frame in range(scan.frames)]
    operator = RayOperator(rt, scan.grid, scan.geometry.detector_shape, tables)

    def volume(frames: np.ndarray) -> np.ndarray:
        return fdk(replace(scan, projections=np.asarray(frames, np.float32)), options, rt).volume

    def regularised(frames: np.ndarray) -> np.ndarray:
        own = replace(scan, projections=np.asarray(frames, np.float32))
        return fista_tv.METHOD.run(own, _LITTLE_VARIATION, rt).volume

    return Model(volume, operator.forward, regularised)
