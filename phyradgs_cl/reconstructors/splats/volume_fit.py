"""Gaussians fitted to a volume: the start drawn from its gradient, then Adam on the squared error of the voxels.

The number of Gaussians does not change. They are drawn where the volume changes, and in its matter, a little smaller than
their distances. Densities are then scaled until the field at their voxels is right. Every step takes all voxels."""

import time
from dataclasses import asdict, dataclass
from typing import ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Activation, Gaussians, Grid
from phyradgs_cl.fields.gaussians import DENSITY
from phyradgs_cl.operators import Voxeliser
from phyradgs_cl.optim import DeviceAdam, Population, Rates
from phyradgs_cl.reconstructors.result import Progress, ProgressReport, Reconstruction, ignore_progress
from phyradgs_cl.reconstructors.splats.device import DeviceCloud
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.splats.start import internal_scale, neighbour_distance
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.algebra import DeviceSpace
from phyradgs_cl.runtime.layout import pad_rows, unpad_rows

_REPORT_EVERY = 10
_MATTER = 0.01  # of the volume's 99.9th percentile
_IN_MATTER = 0.05  # of the mean gradient, added where there is matter: flat parts get Gaussians too
_SCALE_SHARE = 0.6  # of the distance to the nearest others
_SCALE_MIN_VOXELS, _SCALE_MAX = 0.25, 1.0  # the largest in half-sides
_FIRST_DENSITY, _FAINTEST = 0.1, 1e-3  # of a voxel's value; of the 99.9th percentile
_DENSITY_ROUNDS, _LARGEST_CORRECTION = 2, 5.0


@dataclass(frozen=True)
class VolumeFitOptions:
    """``gaussians``: their number; 0 takes one for 16 voxels, from 1,000 to 50,000, as ``reconstruct`` does. ``iterations``:
    steps of Adam. Position rates are in voxels. Raises InputError for numbers out of range."""

    RATES: ClassVar = Rates(position=(0.13, 0.013), scale=(3e-2, 3e-3))

    gaussians: int = checks.ranged(0, 0, 100_000_000, "--gaussians (0 chooses from the grid)")
    iterations: int = checks.ranged(200, 0, 1_000_000, "--iterations")

    def __post_init__(self) -> None:
        checks.fields_within("", self)


def fit_volume(
    rt: Runtime, volume: np.ndarray, grid: Grid, options: VolumeFitOptions, *, seed: int = 0,
    report: ProgressReport = ignore_progress,
) -> Reconstruction:  # fmt: skip
    """Returns Gaussians fitted to ``volume`` (nz, ny, nx) in 1/mm on ``grid``, and their field on it. ``report`` gets the
    relative RMS error every ten steps. Raises InputError for a volume without matter."""
    started = time.perf_counter()
    scale = internal_scale(volume, grid)
    target = np.ascontiguousarray(volume / scale.density_per_mm, np.float32)
    fit = _Fit(rt, target, grid.scaled(1 / scale.length_mm), options, np.random.default_rng(seed))
    for iteration in range(1, options.iterations + 1):
        fit.step(iteration)
        if iteration % _REPORT_EVERY == 0 or iteration == options.iterations:
            done = iteration, options.iterations, fit.relative_error(), fit.cloud.count, time.perf_counter() - started
            report(Progress(*done, quantity="relative error"))
    field, cloud = fit.field(), fit.gaussians().scaled(scale.length_mm, scale.density_per_mm)
    facts = {
        "method": "splat", "options": asdict(options), "seed": seed, "gaussians": cloud.count,
        "seconds": time.perf_counter() - started,
    }
    return Reconstruction(field * np.float32(scale.density_per_mm), grid, cloud, facts=facts)


class _Fit:
    """The Gaussians on the device, the volume ``target`` (nz, ny, nx) and its grid, all in internal units."""

    def __init__(
        self, rt: Runtime, target: np.ndarray, grid: Grid, options: VolumeFitOptions, rng: np.random.Generator
    ) -> None:
        self.rt, self.grid, self.iterations = rt, grid, options.iterations
        voxel = min(grid.voxel_size_mm)
        self.activation = Activation(_SCALE_MIN_VOXELS * voxel, max(_SCALE_MAX, 2 * _SCALE_MIN_VOXELS * voxel))
        self.rates = np.array([voxel] * 3 + [1.0] * 8)
        self.voxels = Voxeliser(rt, grid.shape)
        raw = self.activation.invert(self._first_rows(target, SplatOptions(gaussians=options.gaussians), rng))
        self.cloud = DeviceCloud(rt, Population(raw, np.zeros((2, *raw.shape))))
        self.adam, self.space = DeviceAdam(rt, self.activation), DeviceSpace(rt)
        self.target = self.error = rt.upload(pad_rows(target))
        self.norm = max(self.space.norm(self.target), 1e-30)
        self.statistics = rt.zeros((2, self.cloud.gaussians.stride))

    def _first_rows(self, target: np.ndarray, options: SplatOptions, rng: np.random.Generator) -> np.ndarray:
        """Returns parameter rows (11, G) of round Gaussians at voxels drawn by the size of the gradient."""
        places = drawn_by_gradient(target, options.gaussians_for(self.grid), rng)
        z, y, x = np.unravel_index(places, target.shape)
        axis_z, axis_y, axis_x = self.grid.axes_mm()
        mean = np.stack([axis_x[x], axis_y[y], axis_z[z]], -1)
        spacing = neighbour_distance(mean, max(self.grid.voxel_size_mm))
        lowest, highest = self.activation.scale_min, self.activation.scale_max
        size = np.repeat(np.clip(_SCALE_SHARE * spacing, lowest, highest)[:, None], 3, axis=1)
        value = np.maximum(target.ravel()[places], _FAINTEST)
        turn = np.tile([1.0, 0.0, 0.0, 0.0], (len(mean), 1))
        rows = Gaussians(mean, size, turn, _FIRST_DENSITY * value).rows()
        for _ in range(_DENSITY_ROUNDS):
            field = np.maximum(self.voxels.voxelise(rows, self.grid).ravel()[places], _FAINTEST)
            rows[DENSITY] *= np.clip(value / field, 1 / _LARGEST_CORRECTION, _LARGEST_CORRECTION)
        return rows

    def _error(self) -> DeviceArray:
        """Returns field − target in the padded layout."""
        self.cloud.activate(self.adam)
        return self.space.add(self.voxels.forward(self.cloud.gaussians, self.grid), self.target, -1.0)

    def step(self, number: int) -> None:
        """Does step ``number``, from 1, down the gradient of half the squared error."""
        cloud = self.cloud
        gaussians = cloud.gaussians
        self.error = self._error()
        self.voxels.backward(gaussians, self.grid, self.error, cloud.gradients, add=False)
        own = cloud.raw, gaussians.rows, cloud.gradients, self.statistics, cloud.count, gaussians.stride
        self.adam.chain(*own, density_weight=0.0)
        cloud.move(self.adam, self.rates * VolumeFitOptions.RATES.at((number - 1) / self.iterations), number)

    def relative_error(self) -> float:
        """Returns the RMS error before the last step, over the RMS of the volume."""
        return self.space.norm(self.error) / self.norm

    def field(self) -> np.ndarray:
        """Returns the Gaussians' field (nz, ny, nx)."""
        self.cloud.activate(self.adam)
        return unpad_rows(self.rt.download(self.voxels.forward(self.cloud.gaussians, self.grid)), self.grid.shape)

    def gaussians(self) -> Gaussians:
        return Gaussians.from_rows(self.activation.apply(self.cloud.population().raw.astype(np.float64)))


def drawn_by_gradient(volume: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Returns up to ``count`` flat indices of voxels of ``volume`` (nz, ny, nx), each once, in order. The chance of a voxel
    is the size of the gradient there, and a little more in matter. Raises InputError for a volume without matter."""
    long_axes = [axis for axis, length in enumerate(volume.shape) if length > 1]
    is_matter = (volume > _MATTER).ravel()
    if not is_matter.any():
        raise InputError("volume", f"a largest value of {volume.max():g}", "attenuation above 0 somewhere")
    size = np.sqrt(sum((np.gradient(volume, axis=axis) ** 2 for axis in long_axes), np.zeros(volume.shape))).ravel()
    chance = size + (_IN_MATTER * size.mean() or 1.0) * is_matter
    count = min(count, int(np.count_nonzero(chance)))
    return np.sort(rng.choice(chance.size, count, replace=False, p=chance / chance.sum()))
