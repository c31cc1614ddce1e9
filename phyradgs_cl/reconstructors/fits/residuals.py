"""How well a coarse reconstruction explains the frames, and which of two hypotheses explains them better."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import PerRow, Scan
from phyradgs_cl.acquisition.altered.angles import exposure_steps
from phyradgs_cl.operators.rays.upright import FEWEST_LINES
from phyradgs_cl.reconstructors.fits.augmented import AugmentedOperator, FlatErrors
from phyradgs_cl.reconstructors.voxels.cgls import Cgls
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime

_ITERATIONS = 20
_MOST_TIMES = 12  # per exposure
_DRAWS = 200
_TINY = 1e-30


@dataclass(frozen=True, eq=False)
class Fit:
    """squares (F,): mean squared residual of each frame, dimensionless. level (F,): the constant that the fit added to each
    frame's line integrals."""

    squares: np.ndarray
    level: np.ndarray

    @property
    def total(self) -> float:
        return float(self.squares.sum())


def fit(rt: Runtime, scan: Scan, iterations: int = _ITERATIONS) -> Fit:
    """Reconstructs a coarse scan by CGLS, each line at its own times, together with errors of its flats."""
    across = max(scan.grid.shape[1:])
    motion = PerRow(sub_intervals=exposure_steps(scan, across, 1.0, _MOST_TIMES))
    system = System.of_scan(rt, scan, motion, fewest_lines=FEWEST_LINES)
    flats = FlatErrors.beside(system.operator)
    augmented = AugmentedOperator(system.operator, flats)
    method = Cgls(augmented.system(system.measured, system.valid))
    for _ in range(iterations):
        if method.finished:
            break
        method.step()
    squares = np.square(method.residual, dtype=np.float64).mean((1, 2))
    _, values = augmented.parts(method.volume)
    return Fit(squares, flats.parts(values)[1])


def fit_squares(rt: Runtime, scan: Scan, iterations: int = _ITERATIONS) -> np.ndarray:
    """Returns the mean squared residual (F,) of each frame of a coarse scan, dimensionless."""
    return fit(rt, scan, iterations).squares


def t_statistic(stated: np.ndarray, other: np.ndarray) -> float:
    """Returns by how many standard errors the stated hypothesis explains the frames better than the other.

    stated, other (F,): squared residuals, compared frame by frame, relative to their sum; frames are the sample. 0 with
    fewer than three frames, or where both are the same."""
    difference = (other - stated) / np.maximum(stated + other, _TINY)
    if difference.size < 3:
        return 0.0
    error = float(difference.std(ddof=1)) / np.sqrt(difference.size)
    return float(difference.mean()) / error if error > 0 else 0.0


def residual_ratio(stated: np.ndarray, other: np.ndarray) -> float:
    """Returns the other hypothesis's squared residual (F,) over the stated one's, summed over the frames."""
    return float(other.sum() / max(float(stated.sum()), _TINY))


def vertex(at: np.ndarray, squares: np.ndarray) -> tuple[float, float]:
    """Returns the minimum of a parabola and its standard deviation, by a bootstrap over the frames.

    at (3,): even, ascending places; squares (3, F): each frame's square there. NaN where there is no minimum."""
    frames = squares.shape[1]
    draws = np.random.default_rng(0).integers(0, frames, (_DRAWS, frames))
    drawn = np.array([_minimum(at, squares[:, draw].sum(1)) for draw in draws])
    finite = drawn[np.isfinite(drawn)]
    deviation = float(finite.std(ddof=1)) if finite.size > _DRAWS // 2 else float("nan")
    return _minimum(at, squares.sum(1)), deviation


def _minimum(at: np.ndarray, sums: np.ndarray) -> float:
    step = at[1] - at[0]
    curvature = sums[0] - 2 * sums[1] + sums[2]
    if curvature <= 0:
        return float("nan")
    return float(at[1] + step * np.clip((sums[0] - sums[2]) / (2 * curvature), -3, 3))
