"""A linear system with further unknowns than the volume, solved together with it."""

import math
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.operators.rays.operator import LinearOperator
from phyradgs_cl.reconstructors.voxels.system import System

_FREEDOM = 0.3  # scale of patterns and levels relative to the volume's: without it they take motion for noise


@dataclass(frozen=True, eq=False)
class FlatErrors:
    """Unknowns b: a pattern (rows, columns) common to all frames (noise of flats, air that is not 0) and a level (F,) per
    frame (the source's brightness), in line integrals. ``pattern_unit`` and ``level_unit``: line integral per unknown."""

    frames_shape: tuple[int, int, int]
    pattern_unit: float
    level_unit: float

    @classmethod
    def beside(cls, operator: LinearOperator) -> "FlatErrors":
        """Scales the unknowns to the strength of ``operator``."""
        frames, rows, columns = shape = operator.frames_shape
        back = operator.adjoint(np.ones(shape, np.float32))
        strength = _FREEDOM * float(np.linalg.norm(back)) / math.sqrt(frames * rows * columns)
        return cls(shape, strength / math.sqrt(frames), strength / math.sqrt(rows * columns))

    @property
    def count(self) -> int:
        return math.prod(self.frames_shape[1:]) + self.frames_shape[0]

    def add_to(self, frames: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Returns frames + B values."""
        pattern, level = self.parts(values)
        return frames + pattern + level[:, None, None]

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        return np.concatenate([self.pattern_unit * frames.sum(0).ravel(), self.level_unit * frames.sum((1, 2))])

    def parts(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the pattern (rows, columns) and the levels (F,) in line integrals."""
        frames, rows, columns = self.frames_shape
        pattern, level = np.split(values, [values.size - frames])
        return self.pattern_unit * pattern.reshape(rows, columns), self.level_unit * level


@dataclass(frozen=True, eq=False)
class ViewParameters:
    """Unknowns b: parameters (n, K) of single views. View f has the values ``basis`` (F, n) @ parameters (K,), each of which
    adds that many of its ``signals`` (F, K, rows, columns)."""

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
        """Returns the parameters (n, K)."""
        return values.reshape(self.basis.shape[1], self.signals.shape[1])


@dataclass(frozen=True, eq=False)
class AugmentedOperator:
    """A x + B b of one vector (x, b): a volume and other unknowns. B is scaled to about the strength of A, because CGLS
    moves all unknowns together."""

    operator: LinearOperator
    extra: FlatErrors | ViewParameters

    @property
    def volume_shape(self) -> tuple[int, ...]:
        return (math.prod(self.operator.volume_shape) + self.extra.count,)

    @property
    def frames_shape(self) -> tuple[int, int, int]:
        return self.operator.frames_shape

    def system(self, measured: np.ndarray, valid: np.ndarray | None) -> System:
        """Returns the equations for the measured frames (F, rows, columns). They cannot be divided into subsets."""
        return System(self, measured, valid)  # type: ignore[arg-type]

    def forward(self, vector: np.ndarray) -> np.ndarray:
        volume, values = self.parts(vector)
        return self.extra.add_to(self.operator.forward(volume), values)

    def adjoint(self, frames: np.ndarray) -> np.ndarray:
        volume = self.operator.adjoint(frames).ravel()
        return np.concatenate([volume, self.extra.adjoint(frames)]).astype(np.float32)

    def parts(self, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the volume (z, y, x) and the other unknowns (count,) of a vector."""
        volume, values = np.split(vector, [vector.size - self.extra.count])
        return np.ascontiguousarray(volume.reshape(self.operator.volume_shape)), values
