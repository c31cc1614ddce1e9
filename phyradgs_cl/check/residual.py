"""How well a coarse reconstruction explains the frames."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.acquisition import PerRow, Scan
from phyradgs_cl.check.questions.timing import exposure_arc_rad
from phyradgs_cl.operators.rays.operator import LinearOperator
from phyradgs_cl.reconstructors.voxels.cgls import Cgls
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime

ITERATIONS, ROUGH_ITERATIONS = 20, 8
_MOST_SAMPLES = 12
_FREEDOM = 0.3  # of flats and levels, over the volume's own: without it their noise is taken for motion


@dataclass(frozen=True, eq=False)
class WithFlats:
    """A x + b + c: line integrals of a volume, a pattern b (rows, columns) of all frames (noise of flats, air that is
    not 0) and a level c (F,) of each (the source's); one vector, b and c in units of ``pattern`` and ``level``."""

    operator: LinearOperator
    volume_shape: tuple[int, ...]
    frames_shape: tuple[int, int, int]
    pattern: float
    level: float

    @classmethod
    def of(cls, operator: LinearOperator, frames_shape: tuple[int, int, int]) -> "WithFlats":
        frames, pixels = frames_shape[0], frames_shape[1] * frames_shape[2]
        length = math.prod(operator.volume_shape) + pixels + frames
        back = operator.adjoint(np.ones(frames_shape, np.float32))
        strength = _FREEDOM * float(np.linalg.norm(back)) / math.sqrt(frames * pixels)
        return cls(operator, (length,), frames_shape, strength / math.sqrt(frames), strength / math.sqrt(pixels))

    def forward(self, volume: np.ndarray) -> np.ndarray:
        x, pattern, level = self.parts(volume)
        return self.operator.forward(x) + pattern + level[:, None, None]

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        x = self.operator.adjoint(frames).ravel()
        flats = self.pattern * frames.sum(0).ravel(), self.level * frames.sum((1, 2))
        return np.concatenate([x, *flats]).astype(np.float32)

    def subset(self, frames: Sequence[int]) -> "WithFlats":
        shape = (len(frames), *self.frames_shape[1:])
        return WithFlats.of(self.operator.subset(frames), shape)

    def parts(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(x (z, y, x), b (rows, columns), c (F,)) of a vector."""
        frames, rows, columns = self.frames_shape
        x, pattern, level = np.split(vector, [vector.size - rows * columns - frames, vector.size - frames])
        shaped = np.ascontiguousarray(x.reshape(self.operator.volume_shape))
        return shaped, self.pattern * pattern.reshape(rows, columns), self.level * level


@dataclass(frozen=True, eq=False)
class Fit:
    """squares (F,): mean squared residual of each frame, dimensionless; level (F,): what was added to its line integrals."""

    squares: np.ndarray
    level: np.ndarray

    @property
    def total(self) -> float:
        return float(self.squares.sum())


def system_of(rt: Runtime, scan: Scan) -> System:
    """The scan's equations, every line at its own times: a time for each voxel that its edge moves in an exposure."""
    voxels = exposure_arc_rad(scan) * max(scan.grid.shape[1:]) / 2
    samples = int(np.clip(math.ceil(voxels), 2, _MOST_SAMPLES))
    system = System.of_scan(rt, scan, PerRow(sub_intervals=samples))
    return replace(system, operator=WithFlats.of(system.operator, system.measured.shape))


def fit(system: System, iterations: int = ITERATIONS) -> Fit:
    """``iterations`` of CGLS on all frames of the system."""
    method = Cgls(system)
    for _ in range(iterations):
        if method.finished:
            break
        method.step()
    squares = np.square(method.residual, dtype=np.float64).mean((1, 2))
    return Fit(squares, system.operator.parts(method.volume)[2])  # type: ignore[attr-defined]


def fitted(rt: Runtime, scan: Scan, iterations: int = ITERATIONS) -> np.ndarray:
    """Mean squared residual (F,) of each frame of a coarse scan, dimensionless."""
    return fit(system_of(rt, scan), iterations).squares
