"""Optimisation of Gaussians: Adam, learning-rate schedules, density control."""

from phyradgs_cl.optim.adam import PUBLISHED_RATES, DeviceAdam, Rates, adam_step
from phyradgs_cl.optim.density_control import DensityControl, Population, control_density, prune

__all__ = [
    "PUBLISHED_RATES", "DensityControl", "DeviceAdam", "Population", "Rates", "adam_step", "control_density",
    "prune",
]
