"""Operators between objects and frames: projectors of voxels (rays) and of Gaussians (splats), voxelisation of Gaussians,
and FDK's backprojection. An operator has a domain, a range and a transpose."""

from phyradgs_cl.operators.backproject import backproject, backproject_lines
from phyradgs_cl.operators.rays.intensity import IntensityOperator
from phyradgs_cl.operators.rays.operator import LinearOperator, RayOperator
from phyradgs_cl.operators.splats.layout import DeviceCells, DeviceGaussians
from phyradgs_cl.operators.splats.operator import SplatProjection, VoxelOperator
from phyradgs_cl.operators.splats.projector import DEFAULT_CUTOFF_SIGMA, SplatProjector
from phyradgs_cl.operators.splats.voxelise import Voxeliser, voxelise

__all__ = [
    "DEFAULT_CUTOFF_SIGMA", "DeviceCells", "DeviceGaussians", "IntensityOperator", "LinearOperator", "RayOperator",
    "SplatProjection", "SplatProjector", "VoxelOperator", "Voxeliser", "backproject", "backproject_lines", "voxelise",
]
