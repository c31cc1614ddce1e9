"""Turn and shift of every view by itself: joint least squares of a volume's change and three numbers per view.

A view's numbers move its own frame only, so their signals are images of that frame. Gauss–Newton's normal equations, volume
included, are solved by CGLS at once: what the object would rather do by itself, it does in the same solution.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.level import Level
from phyradgs_cl.calibrate.moved import Change, Views
from phyradgs_cl.check.questions.timing import start_azimuths_rad
from phyradgs_cl.detector import noise_level
from phyradgs_cl.operators.rays.operator import RayOperator
from phyradgs_cl.reconstructors.voxels.cgls import Cgls
from phyradgs_cl.reconstructors.voxels.system import System

TURN, SHIFT_V, SHIFT_U = KINDS = 0, 1, 2
_STEP_PX = 0.25
_MISMATCH = 4.0  # errors that were measured (docs/calibrate.md) over what noise alone would do: voxels are no object


@dataclass(frozen=True, eq=False)
class WithViews:
    """A x + Σ d a: a volume's line integrals, and signals d (F, K, rows, columns) times numbers a (F, K); one vector.
    Signals are in units in which CGLS moves numbers about as fast as it does the object's main features."""

    operator: RayOperator
    signals: np.ndarray
    volume_shape: tuple[int, ...]

    def forward(self, vector: np.ndarray) -> np.ndarray:
        volume, numbers = self.parts(vector)
        return self.operator.forward(volume) + np.einsum("fk,fkvu->fvu", numbers, self.signals)

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        numbers = np.einsum("fkvu,fvu->fk", self.signals, frames)
        return np.concatenate([self.operator.adjoint(frames).ravel(), numbers.ravel()]).astype(np.float32)

    def subset(self, frames: Sequence[int]) -> "WithViews":
        chosen = list(frames)
        length = self.volume_shape[0] - self.signals.shape[1] * (len(self.signals) - len(chosen))
        return WithViews(self.operator.subset(chosen), self.signals[chosen], (length,))

    @property
    def frames_shape(self) -> tuple[int, int, int]:
        return self.operator.frames_shape

    def parts(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(x (z, y, x), a (F, K)) of a vector."""
        frames, kinds = self.signals.shape[:2]
        volume, numbers = np.split(vector, [vector.size - frames * kinds])
        return np.ascontiguousarray(volume.reshape(self.operator.volume_shape)), numbers.reshape(frames, kinds)


def units_of(scan: Scan) -> np.ndarray:
    """What of each number (3,) moves a frame by a pixel at its edge: rad, mm, mm."""
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


def views_of(numbers: np.ndarray) -> Views:
    return Views(numbers[:, 0], numbers[:, 1:])


@dataclass(frozen=True, eq=False)
class Step:
    """``numbers`` (F, 3) to add, 0 for kinds that were not asked for; ``deviations`` (3,) of a view's; rad, mm, mm.
    ``shares`` (3,): what an object leaves of their signals."""

    numbers: np.ndarray
    deviations: np.ndarray
    shares: np.ndarray


def view_step(
    level: Level, change: Change, numbers: np.ndarray, volume: np.ndarray, kinds: Sequence[int], iterations: int
) -> Step:
    """The Gauss–Newton step of all views' numbers of some kinds, from ``numbers`` (F, 3), for the object ``volume``."""
    units = units_of(level.scans[0])
    operator = level.operator(change, views_of(numbers))
    residual = level.line_integrals(operator, volume) - level.masked(operator.forward(volume))
    signals = np.stack([_signal(level, change, numbers, volume, k, units[k]) for k in kinds], 1)
    norms = np.sqrt(np.sum(np.square(signals, dtype=np.float64), (2, 3)))
    scale = _strength(operator) / np.maximum(norms, 0.1 * norms.max(0))
    scaled = (signals * scale[:, :, None, None]).astype(np.float32)
    both = WithViews(operator, scaled, (int(np.prod(operator.volume_shape)) + scale.size,))
    method = Cgls(System(both, residual, level.valid))
    for _ in range(iterations):
        method.step()
    step, deviations, shares = np.zeros(numbers.shape), np.zeros(len(units)), np.zeros(len(units))
    step[:, kinds] = both.parts(method.volume)[1] * scale * units[list(kinds)]
    noise = noise_level(level.measured, level.valid)
    for at, k in enumerate(kinds):
        shares[k] = _share(level, operator, signals[:, at], iterations)
        deviations[k] = _MISMATCH * noise / (shares[k] * float(np.median(norms[:, at])) + 1e-30) * units[k]
    return Step(step, deviations, shares)


def _strength(operator: RayOperator) -> float:
    """About the largest singular value of A: numbers in its units move about as fast as the object's main features."""
    paths = operator.forward(np.ones(operator.volume_shape, np.float32))
    return float(np.linalg.norm(operator.adjoint(paths)) / np.linalg.norm(paths))


def _signal(
    level: Level, change: Change, numbers: np.ndarray, volume: np.ndarray, kind: int, unit: float
) -> np.ndarray:
    """Change of the frames (F, rows, columns) by a pixel's worth of each of their numbers of a kind."""
    step_px = _STEP_PX * level.block
    ends = []
    for sign in (1, -1):
        there = numbers.copy()
        there[:, kind] += sign * step_px * unit
        ends.append(level.operator(change, views_of(there)).forward(volume))
    return level.masked((ends[0] - ends[1]) / np.float32(2 * step_px))


def _share(level: Level, operator: RayOperator, signals: np.ndarray, iterations: int) -> float:
    """What an object leaves of signals (F, rows, columns) whose views go either way, as chance has it."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(signals)).astype(np.float32)
    probe = signals * signs[:, None, None]
    left = level.off_range(operator, probe, iterations)
    return float(np.linalg.norm(left) / max(float(np.linalg.norm(probe)), 1e-30))
