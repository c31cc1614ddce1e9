"""How well a coarse reconstruction explains the frames, and which of two hypotheses (such as two directions of readout)
explains them better. Further unknowns, such as errors of flats, are found together with the volume."""

import math
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import PerRow, Scan
from phyradgs_cl.acquisition.motion import rim_travel_voxels
from phyradgs_cl.operators.rays.operator import LinearOperator
from phyradgs_cl.operators.rays.upright import FEWEST_LINES
from phyradgs_cl.reconstructors.voxels.cgls import Cgls
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime

# In a fit, unknown errors of flats have this fraction of the volume's effect on frames. At 1 they would explain motion too.
_FREEDOM = 0.3
_ITERATIONS = 20  # iterations of CGLS in a fit, by default
_MOST_TIMES = 12  # a fit projects each line at no more than this many times of its exposure, to be fast
_DRAWS = 200  # number of resamplings of the frames in a bootstrap, which gives a standard deviation
_TINY = 1e-30  # least denominator: keeps divisions by squared residuals finite where these are 0


@dataclass(frozen=True, eq=False)
class FlatErrors:
    """Unknown errors b of flats: a pattern (rows, columns) that all frames share (noise of flats, air that is not 0) and a
    level (F,), one per frame (the source's brightness). pattern_unit, level_unit: (line integral)/(unit of the unknown)."""

    frames_shape: tuple[int, int, int]
    pattern_unit: float
    level_unit: float

    @classmethod
    def beside(cls, operator: LinearOperator) -> "FlatErrors":
        """Returns the unknowns for the frames of ``operator``, in units that make their effect on frames ``_FREEDOM`` times
        as strong as the volume's."""
        frames, rows, columns = shape = operator.frames_shape
        back = operator.adjoint(np.ones(shape, np.float32))
        strength = _FREEDOM * float(np.linalg.norm(back)) / math.sqrt(frames * rows * columns)
        return cls(shape, strength / math.sqrt(frames), strength / math.sqrt(rows * columns))

    @property
    def count(self) -> int:
        return math.prod(self.frames_shape[1:]) + self.frames_shape[0]

    def add_to(self, frames: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Returns frames (F, rows, columns) plus the effect on them of the unknowns ``values`` (count,): the term B b of
        ``AugmentedOperator``."""
        pattern, level = self.parts(values)
        return frames + pattern + level[:, None, None]

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        return np.concatenate([self.pattern_unit * frames.sum(0).ravel(), self.level_unit * frames.sum((1, 2))])

    def parts(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pattern (rows, columns) and the levels (F,), in line integrals, of unknowns (count,)."""
        frames, rows, columns = self.frames_shape
        pattern, level = np.split(values, [values.size - frames])
        return self.pattern_unit * pattern.reshape(rows, columns), self.level_unit * level


@dataclass(frozen=True, eq=False)
class ViewParameters:
    """Unknown parameters of views, of K kinds such as shifts. The unknowns are coefficients b (n, K) of n functions of the
    view, ``basis`` (F, n). The K parameters of view f are (basis @ b)[f]. signals (F, K, rows, columns): the Jacobian
    d(frame)/d(its parameters)."""

    signals: np.ndarray
    basis: np.ndarray

    @property
    def count(self) -> int:
        return self.basis.shape[1] * self.signals.shape[1]

    def add_to(self, frames: np.ndarray, values: np.ndarray) -> np.ndarray:
        return frames + np.einsum("fk,fkvu->fvu", self.basis @ self.parts(values), self.signals)

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        return (self.basis.T @ np.einsum("fkvu,fvu->fk", self.signals, frames)).ravel()

    def parts(self, values: np.ndarray) -> np.ndarray:
        """Returns the unknowns ``values`` (n · K,) in the shape of the coefficients b (n, K)."""
        return values.reshape(self.basis.shape[1], self.signals.shape[1])


@dataclass(frozen=True, eq=False)
class AugmentedOperator:
    """Maps a vector (x, b), of a volume x and further unknowns b, to frames A x + B b. operator: A. extra: B, which should
    change frames about as strongly as A, because CGLS moves all unknowns together."""

    operator: LinearOperator
    extra: FlatErrors | ViewParameters

    @property
    def volume_shape(self) -> tuple[int, ...]:
        return (math.prod(self.operator.volume_shape) + self.extra.count,)

    @property
    def frames_shape(self) -> tuple[int, int, int]:
        return self.operator.frames_shape

    def system(self, measured: np.ndarray, valid: np.ndarray | None) -> System:
        """Returns the system of this operator and measured frames (F, rows, columns), which has no subsets. valid: 1 at
        usable pixels, else 0; None: all are usable."""
        return System(self, measured, valid)  # type: ignore[arg-type]

    def forward(self, vector: np.ndarray, out: None = None) -> np.ndarray:
        volume, values = self.parts(vector)
        return self.extra.add_to(self.operator.forward(volume), values)

    def adjoint(self, frames: np.ndarray, out: None = None) -> np.ndarray:
        volume = self.operator.adjoint(frames).ravel()
        return np.concatenate([volume, self.extra.adjoint(frames)]).astype(np.float32)

    def parts(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the volume (nz, ny, nx) and the further unknowns (count,) of a vector (x, b)."""
        volume, values = np.split(vector, [vector.size - self.extra.count])
        return np.ascontiguousarray(volume.reshape(self.operator.volume_shape)), values


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of ``fit``. squares (F,): mean squared residual of each frame, dimensionless. level (F,): the constant that the
    fit added to each frame's line integrals. volume (nz, ny, nx), pattern (rows, columns): what it added to all frames."""

    squares: np.ndarray
    level: np.ndarray
    volume: np.ndarray
    pattern: np.ndarray

    @property
    def total(self) -> float:
        return float(self.squares.sum())

    def squares_of(self, rt: Runtime, scan: Scan) -> np.ndarray:
        """Returns the mean squared residual (F,) of each frame of another scan of the same object and panel, dimensionless.
        A frame's level is free."""
        system = _system(rt, scan)
        residual = system.measured - system.operator.forward(self.volume) - self.pattern
        weight = scan.valid / np.maximum(scan.valid.sum((1, 2), keepdims=True), 1)
        residual -= (weight * residual).sum((1, 2), keepdims=True)
        return np.asarray((weight * np.square(residual, dtype=np.float64)).sum((1, 2)))


def fit(rt: Runtime, scan: Scan, iterations: int = _ITERATIONS) -> Fit:
    """Fits a volume to a coarse scan by CGLS, with every line at its own times, together with errors of the scan's flats."""
    system = _system(rt, scan)
    flats = FlatErrors.beside(system.operator)
    augmented = AugmentedOperator(system.operator, flats)
    method = Cgls(augmented.system(system.measured, system.valid))
    for _ in range(iterations):
        if method.finished:
            break
        method.step()
    squares = np.square(method.residual, dtype=np.float64).mean((1, 2))
    volume, values = augmented.parts(method.volume)
    pattern, level = flats.parts(values)
    return Fit(squares, level, volume, pattern)


def _system(rt: Runtime, scan: Scan) -> System:
    times = min(max(2, math.ceil(rim_travel_voxels(scan))), _MOST_TIMES)
    return System.of_scan(rt, scan, PerRow(times), fewest_lines=FEWEST_LINES)


def fit_squares(rt: Runtime, scan: Scan, iterations: int = _ITERATIONS) -> np.ndarray:
    """Returns the mean squared residual (F,) of each frame of a coarse scan, dimensionless."""
    return fit(rt, scan, iterations).squares


def t_statistic(stated: np.ndarray, other: np.ndarray) -> float:
    """Returns by how many standard errors the stated hypothesis explains the frames better than the other hypothesis.

    stated, other (F,): mean squared residuals of each frame. The sample has a value (other − stated)/(other + stated) for
    each frame. Returns 0 with fewer than three frames, or if all values are equal."""
    difference = (other - stated) / np.maximum(stated + other, _TINY)
    if difference.size < 3:
        return 0.0
    error = float(difference.std(ddof=1)) / np.sqrt(difference.size)
    return float(difference.mean()) / error if error > 0 else 0.0


def residual_ratio(stated: np.ndarray, other: np.ndarray) -> float:
    """Returns Σ other / Σ stated. stated, other (F,): squared residuals of each frame under two hypotheses."""
    return float(other.sum() / max(float(stated.sum()), _TINY))


def vertex(at: np.ndarray, squares: np.ndarray) -> tuple[float, float]:
    """Returns where the parabola through three sums of squares has its minimum, and the standard deviation of this place, by
    a bootstrap over frames.

    at (3,): evenly spaced, ascending values of a parameter. squares (3, F): each frame's squared residual there. The place
    is limited to 3 steps from ``at[1]``, and NaN if the parabola has no minimum. The deviation is NaN if half of the
    resamplings or more have no minimum."""
    frames = squares.shape[1]
    draws = np.random.default_rng(0).integers(0, frames, (_DRAWS, frames))
    drawn = np.array([lowest(at, squares[:, draw].sum(1)) for draw in draws])
    finite = drawn[np.isfinite(drawn)]
    deviation = float(finite.std(ddof=1)) if finite.size > _DRAWS // 2 else float("nan")
    return lowest(at, squares.sum(1)), deviation


def lowest(at: np.ndarray, sums: np.ndarray) -> float:
    """Returns where the parabola through three points has its minimum, at most 3 steps from the middle one; NaN without."""
    step = at[1] - at[0]
    curvature = sums[0] - 2 * sums[1] + sums[2]
    if curvature <= 0:
        return float("nan")
    return float(at[1] + step * np.clip((sums[0] - sums[2]) / (2 * curvature), -3, 3))
