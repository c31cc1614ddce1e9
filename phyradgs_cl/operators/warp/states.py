"""Chooses a few representative states of a moving object. Operators warp a volume to each state only once, and use for each
time the nearest state, or a blend of two."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phyradgs_cl.fields import Deformation, Grid

MOST_STATES = 12  # most states that represent a motion, by default
_SPACING = 0.6  # largest RMS distance, in voxels, of moving voxels from their places in the nearest state, with blends
_SPACING_OF_NEAREST = 0.3  # the same distance if each time takes the nearest state, without a blend
_MOVES = 0.1  # a voxel counts as moving if its squared displacement is at least this fraction of the largest one


@dataclass(frozen=True, eq=False)
class MotionStates:
    """K representative states of ``deformation``, and which of them stand for a time.

    fields_mm: (R, nz, ny, nx, 3) displacements on ``grid`` by each field with weight 1, x, y, z. weights: (K, R), the
    fields' weights in each state. metric: (R, R); two states whose weights differ by d are displaced by √(dᵀ metric d)
    voxels RMS. blends: a time between two states gets a blend of both; else the nearest state."""

    deformation: Deformation
    grid: Grid
    fields_mm: np.ndarray
    weights: np.ndarray
    metric: np.ndarray
    blends: bool = True

    @classmethod
    def of_times(
        cls, deformation: Deformation, grid: Grid, times_s: np.ndarray, least_voxels: float = 0.0, blends: bool = True,
        most: int = MOST_STATES,
    ) -> "MotionStates":  # fmt: skip
        """Chooses at most ``most`` states for times (T,) in s. The first is the object at the time at which its weights are
        nearest to their mean. Each further one is the object when it differs most from all states so far, until at every
        time a state is near enough.

        least_voxels: a change of a weight by 1 counts as at least this displacement, so fields of zeros get states too."""
        units, fields_mm = np.eye(deformation.rank), unit_fields_mm(deformation, grid)
        voxel_mm = min(grid.voxel_size_mm)
        seen = np.unique(deformation.weights_at(times_s), axis=0)
        moving = np.einsum("r,rzyxi->zyx", np.square(seen).max(0), np.square(fields_mm))
        moves = moving >= _MOVES * moving.max(initial=0.0)
        parts = fields_mm[:, moves].reshape(len(units), -1).astype(np.float64) / voxel_mm
        metric = parts @ parts.T / max(np.count_nonzero(moves), 1)
        metric += least_voxels**2 * units
        chosen = [int(np.argmin(_length(seen - seen.mean(0), metric)))]
        spacing = _SPACING if blends else _SPACING_OF_NEAREST
        distance = _length(seen - seen[chosen[0]], metric)
        while len(chosen) < most:
            furthest = int(np.argmax(distance))
            if distance[furthest] <= (spacing if len(chosen) > 1 else 0.0):
                break
            chosen.append(furthest)
            distance = np.minimum(distance, _length(seen - seen[furthest], metric))
        return cls(deformation, grid, fields_mm, seen[chosen], metric, blends)

    @property
    def count(self) -> int:
        """The number of states K."""
        return len(self.weights)

    @property
    def is_at_rest(self) -> bool:
        """Whether the object is always as in the reference volume."""
        return self.count == 1 and self.is_still(0)

    def is_still(self, state: int) -> bool:
        """Returns whether no voxel is displaced in a state."""
        return not np.any(self._has_effect & (self.weights[state] != 0))

    @cached_property
    def _has_effect(self) -> np.ndarray:
        return np.array([field.any() for field in self.fields_mm])

    def shares(self, times_s: np.ndarray | Sequence[float]) -> np.ndarray:
        """Returns the fractions of the states (T, K) at times (T,) in s. They sum to 1, with at most two above 0.

        A blend takes the two states with the smallest error in voxels. The error is a sum: the distance of the object at
        that time from the line between both states, and the blur of adding two volumes displaced against each other."""
        wanted = self.deformation.weights_at(times_s)
        if not self.blends:
            distances = np.stack([_length(wanted - weights, self.metric) for weights in self.weights], -1)
            return np.asarray(np.eye(self.count)[distances.argmin(-1)])
        shares, least = np.zeros((len(wanted), self.count)), np.full(len(wanted), np.inf)
        for first in range(self.count):
            from_first = wanted - self.weights[first]
            for second in range(first, self.count):
                line = self.weights[second] - self.weights[first]
                squared = float(line @ self.metric @ line)
                share = np.clip(from_first @ self.metric @ line / squared, 0, 1) if squared > 0 else np.zeros(len(wanted))
                error = _length(from_first - share[:, None] * line, self.metric) + share * (1 - share) * squared / 2
                better = np.flatnonzero(error < least)
                least[better] = error[better]
                shares[better] = 0
                shares[better, second] = share[better]
                shares[better, first] += 1 - share[better]
        return shares


def unit_fields_mm(deformation: Deformation, grid: Grid) -> np.ndarray:
    """Returns the displacements (R, nz, ny, nx, 3) in mm, x, y, z, by each field with weight 1."""
    return np.stack([deformation.on_grid_mm(grid, unit) for unit in np.eye(deformation.rank)])


def _length(difference: np.ndarray, metric: np.ndarray) -> np.ndarray:
    """Returns the RMS displacements (T,) in voxels that differences (T, R) of weights make."""
    squared: np.ndarray = np.einsum("tr,rs,ts->t", difference, metric, difference)
    return np.asarray(np.sqrt(np.maximum(squared, 0)))
