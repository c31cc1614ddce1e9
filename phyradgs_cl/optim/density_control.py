"""Adaptive density control: clones and splits Gaussians with a large image gradient, and prunes faint and thin ones.

It follows Kerbl et al. 2023 in R2-Gaussian's radiative form. The statistic is the mean norm of dL/d(projected
centre), in normalised detector units. Both halves of a clone or split have half the density."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.fields import Activation
from phyradgs_cl.fields import gaussians as g


@dataclass(frozen=True)
class DensityControl:
    """When and which Gaussians to clone, split and prune. Lengths are in half-sides of the volume, times in fractions of a
    run.

    ``every``: iterations between two rounds; 0 keeps the first population. Gaussians whose longest scale is more than
    ``prune_aspect`` times their shortest are removed (0: never). Such thin sheets and needles lie between the rays, where no
    measurement constrains them, and are visible in the volume."""

    every: int = checks.ranged(100, 0, 1_000_000_000)
    start_iteration: int = checks.ranged(500, 0, 1_000_000_000)
    stop_fraction: float = checks.ranged(0.75, 0, 1)
    threshold: float = checks.ranged(3e-4, 0, 1e6)
    split_scale: float = checks.ranged(0.2, 0, 1e3)
    split_factor: float = checks.ranged(1.6, 1, 1e3)
    prune_density: float = checks.ranged(1e-5, 0, 1e6)
    prune_aspect: float = checks.ranged(50.0, 0, 1e9)
    max_gaussians: int = checks.ranged(500_000, 1, 100_000_000)

    def __post_init__(self) -> None:
        checks.fields_within("control.", self)

    def allows(self, scale: np.ndarray) -> np.ndarray:
        """Returns which Gaussians of scales (3, G) are not too thin, bool (G,)."""
        if self.prune_aspect <= 0:
            return np.ones(scale.shape[1], bool)
        return np.asarray(scale.max(0) <= self.prune_aspect * scale.min(0))

    def is_due(self, iteration: int, iterations: int) -> bool:
        """Returns whether a round is due after ``iteration`` (counted from 1) of a run of ``iterations``."""
        inside = self.start_iteration < iteration < self.stop_fraction * iterations
        return self.every > 0 and inside and iteration % self.every == 0


@dataclass(eq=False)
class Population:
    """Raw parameters (11, G) and Adam's moments (2, 11, G) of the same Gaussians."""

    raw: np.ndarray
    moments: np.ndarray

    @property
    def count(self) -> int:
        return int(self.raw.shape[1])

    def take(self, index: np.ndarray) -> "Population":
        return Population(self.raw[:, index], self.moments[:, :, index])


def control_density(
    population: Population, statistic: np.ndarray, activation: Activation, control: DensityControl,
    box: np.ndarray, rng: np.random.Generator,
) -> Population:
    """Returns the population after one round of density control: clones, splits and prunes.

    statistic (G,): mean gradient norm. box (2, 3): lowest and highest corner x y z; Gaussians with centres outside are
    removed."""
    rows = activation.apply(population.raw)
    room = max(control.max_gaussians - statistic.size, 0)
    has_large_gradient = _strongest(statistic, control.threshold, room)
    is_large = rows[g.SCALE].max(0) > control.split_scale
    cloned = np.flatnonzero(has_large_gradient & ~is_large)
    split = np.flatnonzero(has_large_gradient & is_large)
    rows[g.DENSITY, cloned] *= 0.5
    copies, first = rows[:, cloned].copy(), _children(rows[:, split], control, rng)
    second = _children(rows[:, split], control, rng)
    changed = population.raw.copy()
    changed[:, cloned] = activation.invert(rows[:, cloned])
    new_raw = activation.invert(np.concatenate([copies, first, second], axis=1))
    # Two children replace a Gaussian that is split. A cloned Gaussian stays, with its copy.
    remaining = np.setdiff1d(np.arange(population.count), split)
    raw = np.concatenate([changed[:, remaining], new_raw], axis=1)
    # New Gaussians have no history of gradients.
    fresh = np.zeros((2, g.ROWS, new_raw.shape[1]), population.moments.dtype)
    grown = Population(raw, np.concatenate([population.moments[:, :, remaining], fresh], axis=2))
    return prune(grown, activation, control, box)


def prune(
    population: Population, activation: Activation, control: DensityControl, box: np.ndarray
) -> Population:
    """Returns the population without Gaussians that are faint, outside the box or too thin, sorted by height: neighbours
    then share lines of the detector."""
    rows = activation.apply(population.raw)
    inside = np.all((rows[g.MEAN] >= box[0][:, None]) & (rows[g.MEAN] <= box[1][:, None]), axis=0)
    kept = np.flatnonzero(inside & (rows[g.DENSITY] >= control.prune_density) & control.allows(rows[g.SCALE]))
    return population.take(kept[np.argsort(population.raw[2, kept], kind="stable")])


def _strongest(statistic: np.ndarray, threshold: float, room: int) -> np.ndarray:
    """Returns which statistics are at or above the threshold, bool (G,); of more than ``room``, only the largest."""
    chosen = statistic >= threshold
    if int(chosen.sum()) > room:
        order = np.argsort(-statistic, kind="stable")[:room]
        chosen = np.zeros_like(chosen)
        chosen[order] = statistic[order] >= threshold
    return chosen


def _children(rows: np.ndarray, control: DensityControl, rng: np.random.Generator) -> np.ndarray:
    """Draws one child (11, S) from each Gaussian (11, S): smaller, half as dense, with its centre drawn from the parent's
    distribution."""
    child: np.ndarray = rows.copy()
    child[g.MEAN] += rotate(rows[g.QUATERNION], rng.normal(size=(3, rows.shape[1])) * rows[g.SCALE])
    child[g.SCALE] /= control.split_factor
    child[g.DENSITY] *= 0.5
    return child


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Returns vectors (3, S) rotated by unit quaternions (4, S), w x y z."""
    w, axis = quaternion[0], quaternion[1:]
    cross = 2 * np.cross(axis, vector, axis=0)
    return np.asarray(vector + w * cross + np.cross(axis, cross, axis=0))
