"""The Gauss–Newton step of the parameters, without the signals that a change of the volume explains.

Variable projection (Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413) in Kaufman's form. With A the operator at the
parameters θ, x the volume and P the projector onto A's range, the Jacobian is J = (I − P) ∂A/∂θ x. Each parameter's signal
∂A/∂θ x is a central difference, from which CGLS removes the part that some volume explains. The remaining signals and the
remaining residual give the step, its standard deviations, and the parameters that the frames determine at all."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from phyradgs_cl.calibrate.beads import BeadProblem
from phyradgs_cl.calibrate.parameters import GAUGES, PARAMETERS, Parameter, correction_of
from phyradgs_cl.calibrate.problem import CoarseProblem

LEAST_SHARE = 0.2  # of a signal, the least share beyond what the object and the other parameters explain
LEAST_SHARE_OF_BEADS = 0.02  # the same for a known object, which has no voxels that explain signals by accident
_TINY = 1e-9
_GAUGE_FACTOR, _MOST_GAUGE = 2.0, 0.2  # factor of a gauge's share; most of it to count, as it is large in a wrong geometry


@dataclass(frozen=True, eq=False)
class Reduced:
    """The linear problem of the K parameters ``names`` on one grid. N = F · pixels, ordered by frame.

    - jacobian (K, N): the parts of the signals that no volume explains, per unit of each parameter's field.
    - residual (N,): the part of the residual that no volume explains.
    - sizes (K,): norms of the whole signals. whole_gram (K, K): their inner products over their norms.
    - noise: standard deviation of a pixel. mismatch (K,): factors of the deviations, for errors other than noise."""

    names: tuple[str, ...]
    mismatch: np.ndarray
    jacobian: np.ndarray
    sizes: np.ndarray
    whole_gram: np.ndarray
    residual: np.ndarray
    frames: int
    noise: float

    def only(self, names: Sequence[str]) -> "Reduced":
        """Returns the problem of some parameters. The others are fixed."""
        at = [self.names.index(name) for name in names]
        whole_gram = self.whole_gram[np.ix_(at, at)]
        mismatch, jacobian, sizes = self.mismatch[at], self.jacobian[at], self.sizes[at]
        return replace(
            self, names=tuple(names), whole_gram=whole_gram, mismatch=mismatch, jacobian=jacobian, sizes=sizes
        )

    def relative_to_stated(self, at: Mapping[str, float]) -> "Reduced":
        """Returns the problem, linearised at the values ``at``, with its step counted from the stated values."""
        back = np.array([at.get(name, 0.0) for name in self.names]) @ self.jacobian
        return replace(self, residual=self.residual + back)

    @property
    def unit(self) -> np.ndarray:
        """The remaining signals (K, N) over the norms of the whole signals."""
        return self.jacobian / self.sizes[:, None]

    @property
    def gram(self) -> np.ndarray:
        """Inner products (K, K) of ``unit``. The diagonal is 1 where a volume explains nothing of a signal."""
        unit = self.unit
        return unit @ unit.T

    @property
    def shares(self) -> np.ndarray:
        """How much of each parameter's signal (K,) no object explains, 0 to 1.

        This is the smaller of two ratios. One is the remaining norm over the whole norm. The other is the parameter's
        certainty among all others, over its certainty with a known object."""
        tiny = _TINY * np.eye(len(self.names))
        variance, variance_with_object = (np.diag(np.linalg.inv(gram + tiny)) for gram in (self.gram, self.whole_gram))
        certainty = variance_with_object / variance
        return np.sqrt(np.minimum(np.minimum(certainty, np.diag(self.gram)), 1.0))

    def step(self) -> np.ndarray:
        """Returns the Gauss–Newton step (K,) in the fields' units."""
        return np.linalg.solve(self.gram, self.unit @ self.residual) / self.sizes

    def deviations(self) -> np.ndarray:
        """Returns the standard deviations (K,) of the step, by a sandwich estimator.

        Its sample are the frames, so that noise may be correlated within a frame. Deviations are at least those of white
        noise. The noise that the fit has removed from the residual is added back."""
        unit = self.unit
        residual = self.residual - self.step() @ self.jacobian
        by_frame = (unit * residual).reshape(len(self.names), self.frames, -1).sum(-1)
        scatter = by_frame @ by_frame.T * self.frames / max(self.frames - len(self.names), 1)
        inverse = np.linalg.inv(self.gram)
        variance = np.diag(inverse @ scatter @ inverse)
        white = np.diag(inverse) * self.noise**2
        fitted_noise = max(1.0, self.noise**2 / max(float(np.mean(residual**2)), 1e-30))
        return self.mismatch * np.sqrt(np.maximum(variance * fitted_noise, white)) / self.sizes


def reduced(
    problem: CoarseProblem | BeadProblem, operator: Any, parameters: Sequence[Parameter], at: Mapping[str, float],
    volume: np.ndarray, iterations: int,
) -> Reduced:
    """Linearises the frames about the parameters' values ``at`` (by name) and the object ``volume``.

    operator: that of the problem at these values."""
    signals = [_signal(problem, one, at, volume) for one in parameters]
    images = [*signals, problem.residual(operator, volume)]
    *jacobian, residual = problem.beyond_object(operator, volume, images, iterations)
    whole = np.array([problem.compared(signal) for signal in signals], np.float64)
    sizes = np.maximum(np.linalg.norm(whole, axis=1), 1e-30)
    unit = whole / sizes[:, None]
    return Reduced(
        names=tuple(one.name for one in parameters), mismatch=np.array([one.mismatch for one in parameters]),
        jacobian=np.array([one.ravel() for one in jacobian], np.float64), sizes=sizes,
        whole_gram=unit @ unit.T, residual=residual.ravel().astype(np.float64), frames=len(residual),
        noise=problem.noise(residual),
    )


def _signal(
    problem: CoarseProblem | BeadProblem, one: Parameter, at: Mapping[str, float], volume: np.ndarray
) -> np.ndarray:
    """Returns the change of expected less measured frames (F, rows, columns) per unit of a parameter."""
    step = one.step(problem.scans[0]) * (1 if one.is_timing else problem.block)
    ends = []
    for sign in (1, -1):
        correction = correction_of({**at, one.name: at.get(one.name, 0.0) + sign * step})
        operator: Any = problem.operator(correction)
        ends.append(operator.forward(volume) - problem.measured)  # residuals are small: less rounding
    return problem.masked((ends[0] - ends[1]) / np.float32(2 * step))


def least_shares(problem: Reduced) -> dict[str, float]:
    """Returns by name the least share of each parameter's signal that has to remain, in a problem with ``GAUGES``.

    It exceeds the share that remains of a turn of all views; for parameters that move the image along the axis, that of a
    lift. No frame distinguishes a turn from a turned object. Voxels do not follow such an object exactly, and leave as much
    of any other signal."""
    remaining = {gauge.is_axial: float(problem.only([gauge.name]).shares[0]) for gauge in GAUGES}
    names = [name for name in problem.names if name in PARAMETERS]
    gauge_shares = {name: min(remaining[PARAMETERS[name].is_axial], _MOST_GAUGE) for name in names}
    return {name: max(LEAST_SHARE, _GAUGE_FACTOR * share) for name, share in gauge_shares.items()}


def indistinguishable(problem: Reduced, least: Mapping[str, float]) -> list[dict[str, float]]:
    """Returns combinations of parameters, as weights by name, of which an object explains nearly all.

    Nearly all is all but ``least``: the least share of the parameter with the largest weight."""
    values, vectors = scipy.linalg.eigh(problem.gram, problem.whole_gram + _TINY * np.eye(len(problem.names)))
    limits = np.array([least[problem.names[k]] for k in np.abs(vectors).argmax(0)])
    return [dict(zip(problem.names, map(float, weights), strict=True)) for weights in vectors[:, values < limits**2].T]
