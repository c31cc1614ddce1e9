"""Cubic B-splines in time for the weights of a field, and the bending energy of its control vectors in space."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

_NODES = 4  # times per knot between which the weights of a deformation are straight
_STRETCH = 0.02  # of first differences in the bending energy: a field that is linear in air stays small there


@dataclass(frozen=True)
class TemporalSplines:
    """Uniform cubic B-splines that cover first_s to last_s in ``intervals`` intervals; ``count`` of them."""

    first_s: float
    last_s: float
    intervals: int

    @classmethod
    def of_step(cls, first_s: float, last_s: float, step_s: float) -> "TemporalSplines":
        """Returns splines whose knots are at most ``step_s`` apart."""
        length_s = max(last_s - first_s, 1e-9)
        return cls(first_s, first_s + length_s, max(1, int(np.ceil(length_s / step_s))))

    @property
    def count(self) -> int:
        return self.intervals + 3

    @property
    def step_s(self) -> float:
        return (self.last_s - self.first_s) / self.intervals

    @property
    def node_times_s(self) -> np.ndarray:
        """Times at which weights are stored: four for each interval, and the end."""
        return np.linspace(self.first_s, self.last_s, _NODES * self.intervals + 1)

    def at(self, times_s: np.ndarray) -> np.ndarray:
        """Returns the splines (n, count) at times (n,), which are moved into the covered part."""
        knots_s = self.first_s + self.step_s * np.arange(-3, self.intervals + 4)
        return BSpline(knots_s, np.eye(self.count), 3)(np.clip(times_s, self.first_s, self.last_s))

    def fit(self, times_s: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Returns coefficients (count, R) whose splines follow values (n, R) at times (n,), straight between them."""
        nodes_s = self.node_times_s
        wanted = np.stack([np.interp(nodes_s, times_s, column) for column in values.T], -1)
        return np.asarray(np.linalg.lstsq(self.at(nodes_s), wanted, rcond=None)[0])

    def roughness(self) -> np.ndarray:
        """Returns the matrix (count, count) of the sum of squared second differences of coefficients."""
        return _difference_squares(self.count, 2)


class Bending:
    """Half the gradient of the bending energy of control vectors: Σ ‖∂²U/∂i∂j‖² by differences of coefficients.

    counts: (cz, cy, cx) of the control points."""

    def __init__(self, counts: tuple[int, ...]) -> None:
        self._first = [_difference_squares(n, 1) for n in counts]
        self._second = [_difference_squares(n, 2) for n in counts]

    def __call__(self, control: np.ndarray) -> np.ndarray:
        """Returns K c for control vectors (R, cz, cy, cx, 3); the energy is cᵀ K c."""
        total = np.zeros_like(control)
        for axis in range(3):
            along = _apply(self._first[axis], control, axis)
            total += _apply(self._second[axis], control, axis) + _STRETCH * along
            for other in range(axis):
                total += 2 * _apply(self._first[other], along, other)
        return total


def _difference_squares(count: int, order: int) -> np.ndarray:
    """Returns DᵀD (count, count) of the differences D of an order."""
    differences = np.diff(np.eye(count), order, axis=0)
    return np.asarray(differences.T @ differences)


def _apply(matrix: np.ndarray, control: np.ndarray, axis: int) -> np.ndarray:
    return np.moveaxis(np.tensordot(matrix, control, (1, axis + 1)), 0, axis + 1)
