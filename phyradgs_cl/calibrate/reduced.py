"""What of the parameters' signals no volume takes over, the step that it asks for, and how sure that is.

Variable projection (Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413) in Kaufman's form: J = (I − P_A) ∂A/∂θ x.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from phyradgs_cl.calibrate.beads import BeadLevel
from phyradgs_cl.calibrate.level import Level
from phyradgs_cl.calibrate.parameters import GAUGE, Parameter, change_of

LEAST_SHARE = 0.2  # of a signal, beyond what the object and the other parameters take over
_TINY = 1e-9
_OVER_GAUGE, _MOST_GAUGE = 2.0, 0.2  # and of what is left of a gauge's, which is much where the geometry is wrong


@dataclass(frozen=True, eq=False)
class Reduced:
    """Signals of the parameters ``names`` on one level: ``jacobian`` (K, N) beyond what a volume explains, per unit of each
    parameter's field; ``sizes`` (K,) their norms before; ``residual`` (N,) likewise beyond; both by frame, N = F · pixels.
    ``noise``: standard deviation of a pixel's noise. ``mismatch`` (K,): of errors, over what noise alone would do."""

    names: tuple[str, ...]
    mismatch: np.ndarray
    jacobian: np.ndarray
    sizes: np.ndarray
    whole: np.ndarray
    residual: np.ndarray
    frames: int
    noise: float

    def only(self, names: Sequence[str]) -> "Reduced":
        at = [self.names.index(name) for name in names]
        whole = self.whole[np.ix_(at, at)]
        of = {name: getattr(self, name)[at] for name in ("mismatch", "jacobian", "sizes")}
        return replace(self, names=tuple(names), whole=whole, **of)

    @property
    def gram(self) -> np.ndarray:
        """Inner products (K, K) of the signals, each over the norms that they had before: 1 is nothing lost."""
        unit = self.jacobian / self.sizes[:, None]
        return unit @ unit.T

    @property
    def shares(self) -> np.ndarray:
        """What of each parameter's signal (K,) no object takes over, 0 to 1: of its norm, or if that is less, of how surely
        it would be known beside the others if the object were."""
        known, unknown = (np.diag(np.linalg.inv(g + _TINY * np.eye(len(g)))) for g in (self.whole, self.gram))
        found: np.ndarray = np.sqrt(np.minimum(np.minimum(known / unknown, np.diag(self.gram)), 1.0))
        return found

    def about(self, at: Mapping[str, float]) -> "Reduced":
        """The same problem with its parameters, now at these values, back at what is stated: they are then its step."""
        back = np.array([at.get(name, 0.0) for name in self.names]) @ self.jacobian
        return replace(self, residual=self.residual + back)

    def step(self) -> np.ndarray:
        """The Gauss–Newton step (K,) in the fields' units."""
        unit = self.jacobian / self.sizes[:, None]
        found: np.ndarray = np.linalg.solve(self.gram, unit @ self.residual) / self.sizes
        return found

    def deviations(self) -> np.ndarray:
        """Standard deviations (K,) of the step, frames being the sample, whatever their noise and what it shares within one
        (sandwich estimator). What the fit has taken out of the noise is put back."""
        unit = self.jacobian / self.sizes[:, None]
        left = self.residual - self.step() @ self.jacobian
        by_frame = (unit * left).reshape(len(self.names), self.frames, -1).sum(-1)
        spread = by_frame @ by_frame.T * self.frames / max(self.frames - len(self.names), 1)
        inverse = np.linalg.inv(self.gram)
        variance = np.diag(inverse @ spread @ inverse)
        white = np.diag(inverse) * self.noise**2
        eaten = max(1.0, self.noise**2 / max(float(np.mean(left**2)), 1e-30))
        found: np.ndarray = self.mismatch * np.sqrt(np.maximum(variance * eaten, white)) / self.sizes
        return found


def reduced(
    level: Level | BeadLevel,
    parameters: Sequence[Parameter],
    at: Mapping[str, float],
    volume: np.ndarray,
    iterations: int,
) -> Reduced:
    """The signals of ``parameters`` about the values ``at`` (by name), for the object ``volume``, by central differences."""
    # What a level's operator takes is what it reconstructed.
    operator: Any = level.operator(change_of(at))
    signals = [_signal(level, one, at, volume) for one in parameters]
    images = [*signals, level.at(change_of(at)).residual(operator, volume)]
    *left, beyond = level.off_range(operator, volume, images, iterations)
    compared = np.array([level.compared(signal) for signal in signals], np.float64)
    sizes = np.maximum(np.linalg.norm(compared, axis=1), 1e-30)
    unit = compared / sizes[:, None]
    return Reduced(
        names=tuple(one.name for one in parameters),
        mismatch=np.array([one.mismatch for one in parameters]),
        jacobian=np.array([one.ravel() for one in left], np.float64),
        sizes=sizes,
        whole=unit @ unit.T,
        residual=beyond.ravel().astype(np.float64),
        frames=len(beyond),
        noise=level.noise(beyond),
    )


def _signal(level: Level | BeadLevel, one: Parameter, at: Mapping[str, float], volume: np.ndarray) -> np.ndarray:
    """Change of what is expected over what is measured (F, rows, columns) by a unit of a parameter."""
    step = one.step(level.scans[0]) * (1 if one.is_timing else level.block)
    ends = []
    for sign in (1, -1):
        there = change_of({**at, one.name: at.get(one.name, 0.0) + sign * step})
        operator: Any = level.operator(there)
        ends.append(operator.forward(volume) - level.at(there).measured)
    return level.masked((ends[0] - ends[1]) / np.float32(2 * step))


def gauge_share(level: Level, at: Mapping[str, float], volume: np.ndarray, iterations: int) -> float:
    """What is left of a signal that no frame can tell from another object: what the volume's voxels cannot follow."""
    problem = reduced(level, [GAUGE], at, volume, iterations)
    return float(problem.shares[0])


def least_share(gauge: float) -> float:
    """What has to be left of a parameter's signal, where ``gauge`` is left of one that says nothing."""
    return max(LEAST_SHARE, _OVER_GAUGE * min(gauge, _MOST_GAUGE))


def identifiable(problem: Reduced, least: float) -> tuple[str, ...]:
    """The parameters of which ``least`` is left, all others being free: one that is left as stated, and wrong, would
    else pass its error on."""
    return tuple(name for name, share in zip(problem.names, problem.shares, strict=True) if share >= least)


def alike(problem: Reduced, least: float) -> list[dict[str, float]]:
    """Combinations of parameters of whose signals an object leaves less than ``least``: weights by name, a dict each."""
    values, vectors = scipy.linalg.eigh(problem.gram, problem.whole + _TINY * np.eye(len(problem.names)))
    found = vectors[:, values < least**2].T
    return [dict(zip(problem.names, map(float, weights), strict=True)) for weights in found]
