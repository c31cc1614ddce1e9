"""Adaptive density control: clone and split Gaussians where the image pulls at them, prune what has faded.

After Kerbl et al. 2023 in R2-Gaussian's radiative form: the statistic is the mean norm of the gradient by the
projected centre in normalised detector units; both halves of a clone or split keep half the density.
"""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.fields import Activation
from phyradgs_cl.fields import gaussians as g

_RANGES = {
    "every": (0, 1_000_000_000),
    "start_iteration": (0, 1_000_000_000),
    "stop_fraction": (0, 1),
    "threshold": (0, 1e6),
    "split_scale": (0, 1e3),
    "split_factor": (1, 1e3),
    "prune_density": (0, 1e6),
    "prune_aspect": (0, 1e9),
    "max_gaussians": (1, 100_000_000),
}


@dataclass(frozen=True)
class DensityControl:
    """When and what to clone, split and prune; lengths in half-sides of the volume, fractions of the run.

    ``every`` counts iterations from round to round; 0 leaves the population as it starts. Gaussians whose longest scale is
    more than ``prune_aspect`` times their shortest are removed (0: never): sheets and needles that thin slip between the
    rays, where no measurement holds them back, and stand in the volume all the same.
    """

    every: int = 100
    start_iteration: int = 500
    stop_fraction: float = 0.75
    threshold: float = 3e-4
    split_scale: float = 0.2
    split_factor: float = 1.6
    prune_density: float = 1e-5
    prune_aspect: float = 50.0
    max_gaussians: int = 500_000

    def __post_init__(self) -> None:
        checks.fields_within("control.", self, _RANGES)

    def allows(self, scale: np.ndarray) -> np.ndarray:
        """Which of the scales (3, G) are no thinner than may be."""
        if self.prune_aspect <= 0:
            return np.ones(scale.shape[1], bool)
        allowed: np.ndarray = scale.max(0) <= self.prune_aspect * scale.min(0)
        return allowed

    def is_due(self, iteration: int, iterations: int) -> bool:
        """Whether to act after ``iteration`` (counted from 1)."""
        inside = self.start_iteration < iteration < self.stop_fraction * iterations
        return self.every > 0 and inside and iteration % self.every == 0


@dataclass(eq=False)
class Population:
    """Raw parameters (11, G) and Adam's moments (2, 11, G), which density control rearranges together."""

    raw: np.ndarray
    moments: np.ndarray

    @property
    def count(self) -> int:
        return int(self.raw.shape[1])

    def take(self, index: np.ndarray) -> "Population":
        return Population(self.raw[:, index], self.moments[:, :, index])


def control_density(
    population: Population,
    statistic: np.ndarray,
    activation: Activation,
    control: DensityControl,
    box: np.ndarray,
    rng: np.random.Generator,
) -> Population:
    """One round of density control.

    statistic (G,) mean gradient norm; box (2, 3) lowest and highest corner x y z outside which centres go.
    """
    rows = activation.apply(population.raw)
    room = max(control.max_gaussians - statistic.size, 0)
    chosen = _strongest(statistic, control.threshold, room)
    is_large = rows[g.SCALE].max(0) > control.split_scale
    cloned = np.flatnonzero(chosen & ~is_large)
    split = np.flatnonzero(chosen & is_large)
    rows[g.DENSITY, cloned] *= 0.5
    copies, first = rows[:, cloned].copy(), _children(rows[:, split], control, rng)
    second = _children(rows[:, split], control, rng)
    changed = population.raw.copy()
    changed[:, cloned] = activation.invert(rows[:, cloned])
    new_raw = activation.invert(np.concatenate([copies, first, second], axis=1))
    kept = np.setdiff1d(np.arange(population.count), split)
    raw = np.concatenate([changed[:, kept], new_raw], axis=1)
    fresh = np.zeros((2, g.ROWS, new_raw.shape[1]), population.moments.dtype)
    grown = Population(raw, np.concatenate([population.moments[:, :, kept], fresh], axis=2))
    return prune(grown, activation, control, box)


def prune(
    population: Population, activation: Activation, control: DensityControl, box: np.ndarray
) -> Population:
    """Without what has faded, left the box or become too thin; by height, so that neighbours share detector lines."""
    rows = activation.apply(population.raw)
    inside = np.all((rows[g.MEAN] >= box[0][:, None]) & (rows[g.MEAN] <= box[1][:, None]), axis=0)
    kept = np.flatnonzero(inside & (rows[g.DENSITY] >= control.prune_density) & control.allows(rows[g.SCALE]))
    return population.take(kept[np.argsort(population.raw[2, kept], kind="stable")])


def _strongest(statistic: np.ndarray, threshold: float, room: int) -> np.ndarray:
    """Those at or above the threshold, the strongest first when there is room for few."""
    chosen = statistic >= threshold
    if int(chosen.sum()) > room:
        order = np.argsort(-statistic, kind="stable")[:room]
        chosen = np.zeros_like(chosen)
        chosen[order] = statistic[order] >= threshold
    return chosen


def _children(rows: np.ndarray, control: DensityControl, rng: np.random.Generator) -> np.ndarray:
    """One child of each Gaussian (11, S): drawn from it, smaller, half as dense."""
    child: np.ndarray = rows.copy()
    local = rng.normal(size=(3, rows.shape[1])) * rows[g.SCALE]
    child[g.MEAN] += rotate(rows[g.QUATERNION], local)
    child[g.SCALE] /= control.split_factor
    child[g.DENSITY] *= 0.5
    return child


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors (3, S) turned by unit quaternions (4, S), w x y z."""
    w, axis = quaternion[0], quaternion[1:]
    cross = 2 * np.cross(axis, vector, axis=0)
    turned: np.ndarray = vector + w * cross + np.cross(axis, cross, axis=0)
    return turned
