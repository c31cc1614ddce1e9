"""The attenuation field: a voxel volume on a grid, or a cloud of radiative Gaussians."""

from phyradgs_cl.fields.gaussians import Activation, Gaussians
from phyradgs_cl.fields.grid_choice import GridChoice
from phyradgs_cl.fields.volume import Grid, triple

__all__ = ["Activation", "Gaussians", "Grid", "GridChoice", "triple"]
