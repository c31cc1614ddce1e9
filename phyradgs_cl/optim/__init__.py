"""Optimisation of Gaussians: Adam, learning-rate schedules, density control."""

from phyradgs_cl.optim.adam import DeviceAdam, adam_step
from phyradgs_cl.optim.density_control import DensityControl, Population, control_density, prune
from phyradgs_cl.optim.schedules import Rates

__all__ = ["DensityControl", "DeviceAdam", "Population", "Rates", "adam_step", "control_density", "prune"]
