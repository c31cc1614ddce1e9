"""The attenuation of an object: voxels on a grid or a cloud of radiative Gaussians, and its deformation in time."""

from phyradgs_cl.fields.deformation import Deformation, control_points
from phyradgs_cl.fields.gaussians import Activation, Gaussians
from phyradgs_cl.fields.grid_choice import GridChoice
from phyradgs_cl.fields.hounsfield import Hounsfield
from phyradgs_cl.fields.moving import Gating, MovingTruth, SplineVolume, States, deformed
from phyradgs_cl.fields.volume import Grid, Metal, triple

__all__ = [
    "Activation", "Deformation", "Gating", "Gaussians", "Grid", "GridChoice", "Hounsfield", "Metal",
    "MovingTruth", "SplineVolume", "States", "control_points", "deformed", "triple"
]  # fmt: skip
