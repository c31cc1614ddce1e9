"""Gaussians on the device with all that moves them: raw parameters, Adam's moments, gradients, statistics."""

import numpy as np

from phyradgs_cl.operators import DeviceGaussians
from phyradgs_cl.operators.splats.layout import pad_columns, stride_of
from phyradgs_cl.optim import DeviceAdam, Population
from phyradgs_cl.runtime import Runtime


class DeviceCloud:
    """A population on the device; arrays have ``gaussians.stride`` columns, of which the first ``count`` are real."""

    def __init__(self, rt: Runtime, population: Population) -> None:
        self.rt, self.count = rt, population.count
        stride = stride_of(self.count)
        moments = np.zeros((2, 11, stride), np.float32)
        moments[:, :, : self.count] = population.moments
        self.raw = rt.upload(pad_columns(population.raw))
        self.moments = rt.upload(moments)
        self.gradients = rt.zeros((13, stride))
        self.statistics = rt.zeros((2, stride))
        self.gaussians = DeviceGaussians(rt.zeros((11, stride)), self.count, stride)

    def activate(self, adam: DeviceAdam) -> None:
        """Parameters from the raw ones."""
        adam.activate(self.raw, self.gaussians.rows, self.count, self.gaussians.stride)

    def move(self, adam: DeviceAdam, rates: np.ndarray, step: int) -> None:
        """One step of Adam down the gradients; ``rates`` (11,), ``step`` counts from 1."""
        adam.step(self.raw, self.gradients, self.moments, self.gaussians.stride, rates, step)

    def population(self) -> Population:
        """What is on the device now."""
        count = self.count
        return Population(self.rt.download(self.raw)[:, :count], self.rt.download(self.moments)[:, :, :count])

    def read_statistics(self) -> np.ndarray:
        """Sum of the centre's gradient norms, and in how many frames there was one: (2, count) float32."""
        return self.rt.download(self.statistics)[:, : self.count]

    def write_statistics(self, statistics: np.ndarray) -> None:
        """The inverse of ``read_statistics``."""
        padded = np.zeros((2, self.gaussians.stride), np.float32)
        padded[:, : self.count] = statistics
        self.rt.write(self.statistics, padded)
