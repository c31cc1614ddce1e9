"""Reconstruction and projection for the steps of ``prepare`` that need the object."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import LineMiddles, PerRow, Scan
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.prepare import Model
from phyradgs_cl.reconstructors.fdk import FdkOptions, fdk
from phyradgs_cl.reconstructors.voxels import fista_tv
from phyradgs_cl.runtime import Runtime


def reprojection(rt: Runtime, scan: Scan) -> Model:
    """Returns FDK with every line at the middle of its own exposure, and projection at the same times."""
    motion = LineMiddles()
    fdk_options = FdkOptions(window="hann", motion=motion)
    tv_options = fista_tv.FistaTvOptions(motion=PerRow(sub_intervals=2), iterations=30, tv_weight=0.002)
    tables = [motion.cells(scan, frame).still() for frame in range(scan.frames)]
    operator = RayOperator(rt, scan.grid, scan.geometry.detector_shape, tables)

    def volume(frames: np.ndarray) -> np.ndarray:
        return fdk(replace(scan, projections=np.asarray(frames, np.float32)), fdk_options, rt).volume

    def regularised(frames: np.ndarray) -> np.ndarray:
        own = replace(scan, projections=np.asarray(frames, np.float32))
        return fista_tv.METHOD.run(own, tv_options, rt).volume

    return Model(volume, operator.forward, regularised)
