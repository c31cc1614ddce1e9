"""What of the parameters' signals no volume takes over, the step that it asks for, and how sure that is.

Variable projection (Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413) in Kaufman's form: J = (I − P_A) ∂A/∂θ x.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.calibrate.level import Level
from phyradgs_cl.calibrate.parameters import GAUGE, Parameter, change_of
from phyradgs_cl.detector import noise_level

LEAST_SHARE = 0.2  # of a signal, beyond what the object and the other parameters take over
_OVER_GAUGE = 2.0  # and of what is left of a gauge's


@dataclass(frozen=True, eq=False)
class Reduced:
    """Signals of the parameters ``names`` on one level: ``jacobian`` (K, N) beyond what a volume explains, per unit of each
    parameter's field; ``sizes`` (K,) their norms before; ``residual`` (N,) likewise beyond; both by frame, N = F · pixels.
    ``noise``: standard deviation of a pixel's noise."""

    names: tuple[str, ...]
    jacobian: np.ndarray
    sizes: np.ndarray
    residual: np.ndarray
    frames: int
    noise: float

    def only(self, names: Sequence[str]) -> "Reduced":
        at = [self.names.index(name) for name in names]
        return replace(self, names=tuple(names), jacobian=self.jacobian[at], sizes=self.sizes[at])

    @property
    def gram(self) -> np.ndarray:
        """Inner products (K, K) of the signals, each over the norms that they had before: 1 is nothing lost."""
        unit = self.jacobian / self.sizes[:, None]
        return unit @ unit.T

    @property
    def shares(self) -> np.ndarray:
        """What of each signal's norm (K,) is left once the object and all other parameters have adapted."""
        inverse = np.linalg.pinv(self.gram, rcond=1e-8, hermitian=True)
        return 1 / np.sqrt(np.maximum(np.diag(inverse), 1.0))

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
        found: np.ndarray = np.sqrt(np.maximum(variance * eaten, white)) / self.sizes
        return found


def reduced(
    level: Level,
    parameters: Sequence[Parameter],
    at: Mapping[str, float],
    volume: np.ndarray,
    iterations: int,
) -> Reduced:
    """The signals of ``parameters`` about the values ``at`` (by name), for the object ``volume``, by central differences."""
    operator = level.operator(change_of(at))
    expected = operator.forward(volume)
    signals = [_signal(level, one, at, volume) for one in parameters]
    left = [level.off_range(operator, signal, iterations).ravel() for signal in signals]
    residual = level.line_integrals(operator, volume) - level.masked(expected)
    beyond = level.off_range(operator, residual, iterations)
    return Reduced(
        names=tuple(one.name for one in parameters),
        jacobian=np.array(left, np.float64),
        sizes=np.array([max(float(np.linalg.norm(signal)), 1e-30) for signal in signals]),
        residual=beyond.ravel().astype(np.float64),
        frames=len(beyond),
        noise=noise_level(level.measured, level.valid),
    )


def _signal(level: Level, one: Parameter, at: Mapping[str, float], volume: np.ndarray) -> np.ndarray:
    """Change of the frames (F, rows, columns) by a unit of a parameter."""
    step = one.step(level.scans[0]) * (1 if one.is_timing else level.block)
    ends = []
    for sign in (1, -1):
        there = {**at, one.name: at.get(one.name, 0.0) + sign * step}
        ends.append(level.operator(change_of(there)).forward(volume))
    return level.masked((ends[0] - ends[1]) / np.float32(2 * step))


def gauge_share(level: Level, at: Mapping[str, float], volume: np.ndarray, iterations: int) -> float:
    """What is left of a signal that no frame can tell from another object: what the volume's voxels cannot follow."""
    problem = reduced(level, [GAUGE], at, volume, iterations)
    return float(problem.shares[0])


def least_share(gauge: float) -> float:
    """What has to be left of a parameter's signal, where ``gauge`` is left of one that says nothing."""
    return max(LEAST_SHARE, _OVER_GAUGE * gauge)


def identifiable(problem: Reduced, least: float) -> tuple[str, ...]:
    """The parameters that the frames tell, together: the one of which least is left goes, till ``least`` is left of each."""
    names = problem.names
    while names:
        shares = problem.only(names).shares
        worst = int(np.argmin(shares))
        if shares[worst] >= least:
            break
        names = names[:worst] + names[worst + 1 :]
    return names


def alike(problem: Reduced, least: float) -> list[dict[str, float]]:
    """Combinations of parameters that leave less than ``least`` of their signals: weights by name, a dict each."""
    values, vectors = np.linalg.eigh(problem.gram)
    found = vectors[:, values < least**2].T
    return [dict(zip(problem.names, map(float, weights), strict=True)) for weights in found]
