"""Numbers per view, of each by itself or along splines of time: joint least squares of a volume's change and of them.

A view's numbers move its own frame only, so their signals are images of that frame. Gauss–Newton's normal equations, volume
included, are solved by CGLS at once: what the object would rather do by itself, it does in the same solution.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.level import Level
from phyradgs_cl.calibrate.moved import Change, Sway, Views, drift_course, splines
from phyradgs_cl.check.questions.timing import start_azimuths_rad
from phyradgs_cl.detector import noise_level
from phyradgs_cl.operators.rays.operator import RayOperator
from phyradgs_cl.reconstructors.voxels.cgls import Cgls
from phyradgs_cl.reconstructors.voxels.system import System

TURN, SHIFT_V, SHIFT_U = KINDS = 0, 1, 2
_STEP_PX = 0.25
# Errors that were measured (docs/calibrate.md) over what noise alone would do: voxels are no object.
_MISMATCH_OF_VIEWS, _MISMATCH_OF_OBJECT = 4.0, 7.0


@dataclass(frozen=True, eq=False)
class Numbers:
    """What is looked for: ``values`` (n, K), of which view f has ``basis`` (F, n) @ values (K,). ``units`` (K,): what of
    each moves a frame by a pixel at its edge. ``views``: what values move, when they are put into a scan. ``mismatch``: of
    their errors, over what noise alone would do."""

    values: np.ndarray
    basis: np.ndarray
    units: np.ndarray
    views: Callable[[np.ndarray], Views | Sway]
    mismatch: float = _MISMATCH_OF_VIEWS

    def operator(self, level: Level, change: Change, more: np.ndarray | float = 0.0) -> RayOperator:
        return level.operator(change, self.views(self.values + more))


def numbers_of_views(scan: Scan, count: int = 0) -> Numbers:
    """A turn and two shifts of every view by itself, or by ``count`` splines of time."""
    basis = splines(drift_course(scan) + 0.5, count) if count else np.eye(scan.frames)
    return Numbers(np.zeros((basis.shape[1], len(KINDS))), basis, units_of(scan), lambda values: views_of(basis @ values))


def numbers_of_sway(scan: Scan, count: int) -> Numbers:
    """Three turns and three shifts of the object, each by ``count`` splines of time."""
    none = Sway.none(scan, count)
    middle_s = np.asarray(scan.frame_start_s) + scan.shutter.middle_s
    turn, _, shift_mm = units_of(scan)
    units = np.array([turn] * 3 + [shift_mm / scan.geometry.magnification] * 3)
    basis, moving = none.basis(middle_s), lambda values: replace(none, coefficients=values)
    return Numbers(none.coefficients, basis, units, moving, _MISMATCH_OF_OBJECT)


@dataclass(frozen=True, eq=False)
class WithViews:
    """A x + Σ d (basis a): a volume's line integrals, and signals d (F, K, rows, columns) times numbers of views, which
    come of a (n, K) by ``basis`` (F, n); one vector. Signals are in units in which CGLS moves numbers about as fast as it
    does the object's main features."""

    operator: RayOperator
    signals: np.ndarray
    basis: np.ndarray
    volume_shape: tuple[int, ...]

    def forward(self, vector: np.ndarray) -> np.ndarray:
        volume, values = self.parts(vector)
        return self.operator.forward(volume) + np.einsum("fk,fkvu->fvu", self.basis @ values, self.signals)

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        values = self.basis.T @ np.einsum("fkvu,fvu->fk", self.signals, frames)
        return np.concatenate([self.operator.adjoint(frames).ravel(), values.ravel()]).astype(np.float32)

    def subset(self, frames: Sequence[int]) -> "WithViews":
        chosen = list(frames)
        return WithViews(self.operator.subset(chosen), self.signals[chosen], self.basis[chosen], self.volume_shape)

    @property
    def frames_shape(self) -> tuple[int, int, int]:
        return self.operator.frames_shape

    def parts(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(x (z, y, x), a (n, K)) of a vector."""
        shape = self.basis.shape[1], self.signals.shape[1]
        volume, values = np.split(vector, [vector.size - shape[0] * shape[1]])
        return np.ascontiguousarray(volume.reshape(self.operator.volume_shape)), values.reshape(shape)


def units_of(scan: Scan) -> np.ndarray:
    """What of each number (3,) of a view moves a frame by a pixel at its edge: rad, mm, mm."""
    pitch_v_mm, pitch_u_mm = scan.geometry.pixel_size_mm
    edge_mm = max(scan.grid.size_mm[1:]) / 2 * scan.geometry.magnification
    return np.array([pitch_u_mm / edge_mm, pitch_v_mm, pitch_u_mm])


def without_gauges(scan: Scan, numbers: np.ndarray) -> np.ndarray:
    """Numbers (F, 3) without what an object turned, or lying elsewhere, looks like: the mean of turns and of shifts along v,
    and of shifts along u what goes as the cosine and sine of the angle."""
    azimuth = start_azimuths_rad(scan)
    circle = np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    found = numbers.copy()
    found[:, :2] -= found[:, :2].mean(0)
    found[:, 2] -= circle @ np.linalg.lstsq(circle, found[:, 2], rcond=None)[0]
    return found


def without_smooth_gauges(scan: Scan, numbers: Numbers, values: np.ndarray) -> np.ndarray:
    """Values (n, 3) without what ``without_gauges`` takes out, as far as splines follow it."""
    circle = _circle(scan, numbers.basis)
    found = values.copy()
    found[:, :2] -= (numbers.basis @ found[:, :2]).mean(0)
    found[:, 2] -= circle @ np.linalg.lstsq(numbers.basis @ circle, numbers.basis @ found[:, 2], rcond=None)[0]
    return found


def _circle(scan: Scan, basis: np.ndarray) -> np.ndarray:
    """Values (n, 2) that go as the cosine and sine of the angle, as far as a ``basis`` (F, n) does."""
    azimuth = start_azimuths_rad(scan)
    found: np.ndarray = np.linalg.lstsq(basis, np.stack([np.cos(azimuth), np.sin(azimuth)], -1), rcond=None)[0]
    return found


def without_sway_gauges(scan: Scan, numbers: Numbers, values: np.ndarray) -> np.ndarray:
    """Values (n, 6) without what another object looks like: one that lies elsewhere, the mean of each; one that is larger or
    smaller, shifts along x and y that keep to the source's side."""
    beside = _circle(scan, numbers.basis)
    found = values - (numbers.basis @ values).mean(0)
    beside -= (numbers.basis @ beside).mean(0)
    there, pattern = numbers.basis @ found[:, 3:5], numbers.basis @ beside
    found[:, 3:5] -= np.sum(there * pattern) / np.sum(pattern**2) * beside
    return found


def views_of(numbers: np.ndarray) -> Views:
    return Views(numbers[:, 0], numbers[:, 1:])


@dataclass(frozen=True, eq=False)
class Step:
    """``values`` (n, K) to add, 0 for kinds that were not asked for; ``signals`` (F, kinds, rows, columns) of a pixel's
    worth of those that were."""

    values: np.ndarray
    signals: np.ndarray


def view_step(
    level: Level, change: Change, numbers: Numbers, volume: np.ndarray, kinds: Sequence[int], iterations: int
) -> Step:
    """The Gauss–Newton step of some kinds of all numbers, from where they are, for the object ``volume``."""
    operator = numbers.operator(level, change)
    residual = level.residual(operator, volume)
    signals = np.stack([_signal(level, change, numbers, volume, k) for k in kinds], 1)
    norms = np.sqrt(numbers.basis.T**2 @ np.sum(np.square(signals, dtype=np.float64), (2, 3)))  # of a value's own
    scale = _strength(operator) / np.maximum(norms, 0.1 * norms.max(0))
    if not np.array_equal(numbers.basis, np.eye(len(signals))):
        scale = np.broadcast_to(scale.mean(0), scale.shape)  # splines reach over many views
    per_view = numbers.basis @ scale / numbers.basis.sum(1, keepdims=True)
    scaled = (signals * per_view[:, :, None, None]).astype(np.float32)
    both = WithViews(operator, scaled, numbers.basis, (int(np.prod(operator.volume_shape)) + scale.size,))
    method = Cgls(System(both, residual, level.valid))
    for _ in range(iterations):
        method.step()
        level.count_pass()
    step = np.zeros(numbers.values.shape)
    step[:, kinds] = both.parts(method.volume)[1] * scale * numbers.units[list(kinds)]
    return Step(step, signals)


def certainty(
    level: Level, change: Change, numbers: Numbers, signals: np.ndarray, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """(deviations (K,) of a view's number of each kind, what an object leaves (K,) of their ``signals``, (F, K, rows,
    columns)). A view's number is a mean of a few values, whose errors are taken to be their own."""
    operator = numbers.operator(level, change)
    norms = np.sqrt(numbers.basis.T**2 @ np.sum(np.square(signals, dtype=np.float64), (2, 3)))
    noise = noise_level(level.measured, level.valid)
    shares = np.array([_share(level, operator, numbers.basis, signals[:, k], iterations) for k in range(signals.shape[1])])
    mean = np.sqrt(np.mean(np.sum(numbers.basis**2, 1)))
    return numbers.mismatch * mean * noise / (shares * np.median(norms, 0) + 1e-30) * numbers.units, shares


def _strength(operator: RayOperator) -> float:
    """About the largest singular value of A: numbers in its units move about as fast as the object's main features."""
    paths = operator.forward(np.ones(operator.volume_shape, np.float32))
    return float(np.linalg.norm(operator.adjoint(paths)) / np.linalg.norm(paths))


def _signal(level: Level, change: Change, numbers: Numbers, volume: np.ndarray, kind: int) -> np.ndarray:
    """Change of the frames (F, rows, columns) by a pixel's worth of each of their numbers of a kind."""
    step_px = _STEP_PX * level.block
    step = np.zeros(len(numbers.units))
    step[kind] = step_px * numbers.units[kind]
    ends = [numbers.operator(level, change, sign * step).forward(volume) for sign in (1, -1)]
    return level.masked((ends[0] - ends[1]) / np.float32(2 * step_px))


def _share(level: Level, operator: RayOperator, basis: np.ndarray, signals: np.ndarray, iterations: int) -> float:
    """What an object leaves of signals (F, rows, columns) whose numbers go either way, as chance has it."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], basis.shape[1]).astype(np.float32)
    probe = signals * (basis @ signs).astype(np.float32)[:, None, None]
    (left,) = level.off_range(operator, np.zeros(operator.volume_shape, np.float32), [probe], iterations)
    return float(np.linalg.norm(left) / max(float(np.linalg.norm(probe)), 1e-30))
