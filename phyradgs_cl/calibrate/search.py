"""Searches for the parameters that all views share, with Gauss–Newton steps from coarse to fine grids.

On each grid a volume is reconstructed, and each parameter's signal is computed: the change of the frames per unit of the
parameter. The part of a signal that a change of the volume explains is removed (``reduced``). Steps end when they are small,
or when their number reaches the limit of the grid. On the first grid each step also decides which parameters the frames
determine. In a ``BeadProblem`` a known object of beads replaces the volume.

The steps are variable projection (Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413) in Kaufman's form. With A the
operator at the parameters θ, x the volume and P the projector onto A's range, the Jacobian is J = (I − P) ∂A/∂θ x. The
signal ∂A/∂θ x is a central difference, from which CGLS removes the part P ∂A/∂θ x. The remaining signals and residual give
the step and its standard deviations. A parameter's share is the fraction of its signal that remains; if it is too small, the
frames do not determine the parameter."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.beads import BeadProblem
from phyradgs_cl.calibrate.parameters import GAUGES, PARAMETERS, Parameter, correction_of, in_words
from phyradgs_cl.calibrate.per_view import DISCRETISATION
from phyradgs_cl.calibrate.problem import CoarseProblem, Stage
from phyradgs_cl.calibrate.result import AGREES, CANNOT_TELL, CORRECTED, ParameterEstimate

# Frames determine a parameter if its share, the fraction of its signal that no object explains, is at least this.
LEAST_SHARE = 0.2
# For a known object (beads) a smaller share is enough, because there are no voxels that explain signals by accident.
LEAST_SHARE_OF_BEADS = 0.02
_TINY = 1e-9  # added to the diagonal of a matrix before its inverse, because signals may be linearly dependent
# A parameter is determined only if its share is at least this many times that of a turn or a lift (``GAUGES``). No frame
# shows these two, so their share is due to errors of voxels alone.
_GAUGE_FACTOR = 2.0
# The share of a turn or a lift counts as at most this. It grows in a wrong geometry, where without this limit no parameter
# would count as determined.
_MOST_GAUGE = 0.2
DEVIATIONS = 3.0  # a parameter is corrected if |found − stated value| exceeds this many of its standard deviations
# A parameter returns to its stated value only if no corrected one moves by more than this many standard deviations: √2, from
# which on Akaike's criterion prefers the joint estimate of two parameters that resemble each other.
_MOST_MOVED = math.sqrt(2.0)
_MOST_PX = 2.0  # most coarse pixels by which a step moves the image's edge: a larger step's effect is not linear
_SETTLED = 0.1  # the steps on a grid end when each parameter has (step) / (standard deviation) below this


@dataclass(frozen=True, eq=False)
class Reduced:
    """The linear problem of the K parameters ``names`` on one grid. N = F · pixels, ordered by frame.

    - jacobian (K, N): the part of each signal d(frames)/d(parameter) that no volume explains.
    - residual (N,): the part of measured minus expected frames that no volume explains.
    - sizes (K,): norms of the whole signals. whole_gram (K, K): inner products of the whole signals divided by their norms.
    - noise: standard deviation of a pixel. mismatch (K,): factors on standard deviations, for errors other than noise."""

    names: tuple[str, ...]
    mismatch: np.ndarray
    jacobian: np.ndarray
    sizes: np.ndarray
    whole_gram: np.ndarray
    residual: np.ndarray
    frames: int
    noise: float

    def only(self, names: Sequence[str]) -> "Reduced":
        """Returns the problem of the parameters ``names``, with the others fixed."""
        at = [self.names.index(name) for name in names]
        whole_gram = self.whole_gram[np.ix_(at, at)]
        mismatch, jacobian, sizes = self.mismatch[at], self.jacobian[at], self.sizes[at]
        return replace(
            self, names=tuple(names), whole_gram=whole_gram, mismatch=mismatch, jacobian=jacobian, sizes=sizes
        )

    def relative_to_stated(self, at: Mapping[str, float]) -> "Reduced":
        """Returns the problem for unknowns that count from the stated values. So far they count from the values at which it
        was linearised: stated values + ``at`` (by name)."""
        back = np.array([at.get(name, 0.0) for name in self.names]) @ self.jacobian
        return replace(self, residual=self.residual + back)

    @property
    def unit(self) -> np.ndarray:
        """The part of each signal that no volume explains, divided by the norm of the whole signal, (K, N)."""
        return self.jacobian / self.sizes[:, None]

    @property
    def gram(self) -> np.ndarray:
        """Inner products (K, K) of the rows of ``unit``. The diagonal is 1 if a volume explains nothing of a signal."""
        unit = self.unit
        return unit @ unit.T

    @property
    def shares(self) -> np.ndarray:
        """The fraction (K,) of each parameter's signal that no object explains, 0 to 1.

        This is the smaller of two ratios. One is (norm of the unexplained signal) / (norm of the whole signal). The other is
        (standard deviation for a known object) / (standard deviation for an unknown object) of the parameter."""
        tiny = _TINY * np.eye(len(self.names))
        variance, variance_with_object = (np.diag(np.linalg.inv(gram + tiny)) for gram in (self.gram, self.whole_gram))
        certainty = variance_with_object / variance
        return np.sqrt(np.minimum(np.minimum(certainty, np.diag(self.gram)), 1.0))

    def step(self) -> np.ndarray:
        """Returns the Gauss–Newton step (K,) of the parameters, in the units of their ``GeometryCorrection`` fields."""
        return np.linalg.solve(self.gram, self.unit @ self.residual) / self.sizes

    def deviations(self) -> np.ndarray:
        """Returns the standard deviations (K,) of ``step()``, in the same units, by a sandwich estimator.

        Its samples are the frames, so noise may be correlated within a frame. Deviations are at least those of white noise.
        A factor makes up for the noise that the fit has removed from the residual."""
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
    """Returns the linear problem of ``parameters`` at their values ``at`` (by name) and at the object ``volume``: a volume,
    or a placement of beads.

    operator: the projector at these values. iterations: of CGLS, which removes what a volume explains."""
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
    """Returns the signal (F, rows, columns) of a parameter: d(expected frames)/d(its field's value); 0 at invalid pixels."""
    step = one.step(problem.scans[0]) * (1 if one.is_timing else problem.block)
    ends = []
    for sign in (1, -1):
        correction = correction_of({**at, one.name: at.get(one.name, 0.0) + sign * step})
        operator: Any = problem.operator(correction)
        ends.append(operator.forward(volume) - problem.measured)  # small numbers: float32 rounds their difference little
    return problem.masked((ends[0] - ends[1]) / np.float32(2 * step))


def least_shares(problem: Reduced) -> dict[str, float]:
    """Returns each parameter's least share, by name, to count as determined. ``problem`` includes the ``GAUGES``.

    No frame distinguishes a turn of all views from a turned object. Voxels do not follow such an object exactly, though:
    they leave some of the turn's signal unexplained, and as much of any other signal. So a parameter's share must be at
    least 0.2, and twice min(0.2, the turn's share), or a lift's if the parameter moves the image along the axis."""
    remaining = {gauge.is_axial: float(problem.only([gauge.name]).shares[0]) for gauge in GAUGES}
    names = [name for name in problem.names if name in PARAMETERS]
    gauge_shares = {name: min(remaining[PARAMETERS[name].is_axial], _MOST_GAUGE) for name in names}
    return {name: max(LEAST_SHARE, _GAUGE_FACTOR * share) for name, share in gauge_shares.items()}


def indistinguishable(problem: Reduced, least: Mapping[str, float]) -> list[dict[str, float]]:
    """Returns combinations of parameters, as weights by name, whose signal another object explains almost wholly: the share
    that no object explains is below the limit in ``least`` for the parameter with the largest weight."""
    values, vectors = scipy.linalg.eigh(problem.gram, problem.whole_gram + _TINY * np.eye(len(problem.names)))
    limits = np.array([least[problem.names[k]] for k in np.abs(vectors).argmax(0)])
    return [dict(zip(problem.names, map(float, weights), strict=True)) for weights in vectors[:, values < limits**2].T]


Problem = CoarseProblem | BeadProblem


@dataclass(frozen=True)
class Fallback:
    """A parameter's estimate from outside of the search. value: estimate minus stated value, in the parameter's unit.
    deviation: its standard deviation. is_significant: whether the value is applied."""

    value: float
    deviation: float
    is_significant: bool

    @property
    def correction(self) -> float:
        return self.value if self.is_significant else 0.0


@dataclass(eq=False)
class Search:
    """The state of a search.

    - at: current minus stated values, by name, in units of ``GeometryCorrection``. former: ``at`` when the previous grid
      ended; ``at`` − ``former`` shows the error of the voxels.
    - determined: the parameters that the frames determine; None before the first step.
    - fallback: estimates from outside of the search, for parameters that are not determined. fixed: the fallbacks in use.
    - held: parameters that are not fitted, because wrong values would fit better.
    - shares: each parameter's share, by name. alike: combinations, in words, that no frame distinguishes.
    - reduced: the last linear problem."""

    parameters: Sequence[Parameter]
    held: tuple[str, ...] = ()
    fallback: Mapping[str, Fallback] = field(default_factory=dict)
    fixed: dict[str, Fallback] = field(default_factory=dict)
    at: dict[str, float] = field(default_factory=dict)
    former: dict[str, float] = field(default_factory=dict)
    determined: tuple[str, ...] | None = None
    shares: dict[str, float] = field(default_factory=dict)
    alike: list[str] = field(default_factory=list)
    reduced: Reduced | None = None

    def descend(self, problem: Problem, stage: Stage) -> None:
        """Moves the parameters on the grid of ``stage`` until the steps are small, at most ``stage.steps`` times."""
        volume: np.ndarray | None = None
        compared = problem.without_cut_ends() if isinstance(problem, CoarseProblem) else problem
        asks = self.determined is None
        self.former = {} if asks or isinstance(problem, BeadProblem) else dict(self.at)
        for number in range(stage.steps):
            parameters = self.parameters if asks else [PARAMETERS[name] for name in self.determined or ()]
            operator: Any = problem.operator(correction_of(self.at))
            volume = problem.reconstruct(operator, volume, stage.again if number else stage.first)
            more = GAUGES if asks and isinstance(problem, CoarseProblem) else ()
            linear = reduced(compared, operator, [*parameters, *more], self.at, volume, stage.project)
            if asks:
                self._decide_determined(linear)
            self.reduced = self._possible(linear.relative_to_stated(self.at))
            if not self.determined or self._step(problem):
                return

    def _decide_determined(self, linear: Reduced) -> None:
        """Decides which parameters the frames determine: those with a large enough share and, of angles, those with a
        standard deviation below 10°."""
        has_gauges = GAUGES[0].name in linear.names
        least = least_shares(linear) if has_gauges else dict.fromkeys(linear.names, LEAST_SHARE_OF_BEADS)
        linear = linear.only([one.name for one in self.parameters])
        shares = [pair for pair in zip(linear.names, linear.shares, strict=True) if pair[0] not in self.held]
        names = tuple(name for name, share in shares if share >= least[name])
        deviations = linear.only(names).deviations() if names else ()
        self.determined = tuple(n for n, d in zip(names, deviations, strict=True) if PARAMETERS[n].is_known(float(d)))
        self.shares = dict(zip(linear.names, linear.shares.tolist(), strict=True))
        self.fixed = {name: estimate for name, estimate in self.fallback.items() if name not in self.determined}
        free = linear.only([name for name in linear.names if name not in self.fixed])
        self.alike = [in_words(weights) for weights in indistinguishable(free, least)] if free.names else []
        for name, estimate in self.fixed.items():
            self.at[name] = estimate.correction

    def _possible(self, linear: Reduced) -> Reduced:
        """Returns the problem of the determined parameters. Those that would need an impossible value are no longer
        determined."""
        assert self.determined is not None
        while True:
            problem = linear.only(self.determined)
            values = problem.step() if self.determined else ()
            possible = tuple(n for n, v in zip(self.determined, values, strict=True) if PARAMETERS[n].is_possible(float(v)))
            if possible == self.determined:
                return problem
            self.determined = possible

    def _step(self, problem: Problem) -> bool:
        """Moves the determined parameters by the Gauss–Newton step, each by at most two coarse pixels of the image's edge.
        Returns whether all steps were below a tenth of their standard deviations."""
        assert self.reduced is not None and self.determined is not None
        current = np.array([self.at.get(name, 0.0) for name in self.determined])
        change = self.reduced.step() - current
        self.at = {name: estimate.correction for name, estimate in self.fixed.items()}
        for name, old, difference in zip(self.determined, current, change, strict=True):
            most = _MOST_PX * problem.block / PARAMETERS[name].pixels(problem.scans[0])
            lowest = PARAMETERS[name].lowest(problem.scans[0])
            self.at[name] = max(old + float(np.clip(difference, -most, most)), lowest)
        return bool(np.all(np.abs(change) < _SETTLED * self.reduced.deviations()))

    def keep_held(self) -> None:
        """Drops all estimates except the fallbacks of held parameters."""
        self.determined = ()
        self.fixed = {name: estimate for name, estimate in self.fixed.items() if name in self.held}

    def estimates(self) -> dict[str, tuple[float, float]]:
        """Returns the determined parameters' values minus stated values, and their standard deviations, by name.

        A deviation combines noise and discretisation error, taken as half the change since the coarser grid. It is larger
        for a parameter whose effect resembles an undetermined one's, because the latter keeps a stated value that may be
        wrong."""
        if self.reduced is None or not self.determined:
            return {}
        values, noise = self.reduced.step(), self.reduced.deviations()
        change = values - [self.former.get(name, value) for name, value in zip(self.determined, values, strict=True)]
        resemblance = np.maximum(self.reduced.shares / [self.shares[name] for name in self.determined], 1.0)
        deviations = resemblance * np.hypot(noise, DISCRETISATION * change)
        return dict(zip(self.determined, zip(values.tolist(), deviations.tolist(), strict=True), strict=True))

    def corrections(self) -> dict[str, float]:
        """Returns the corrections by name, found minus stated values: of the parameters for which they exceed three standard
        deviations, of those that must be corrected together with these (``_back_to_stated``), and significant fallbacks in
        use. All other parameters go back to their stated values."""
        found = self.estimates()
        significant = {name: estimate.correction for name, estimate in self.fixed.items() if estimate.is_significant}
        off = [name for name, (value, deviation) in found.items() if abs(value) > DEVIATIONS * deviation]
        return significant | (self._back_to_stated(found, off) if off else {})

    def _back_to_stated(self, found: Mapping[str, tuple[float, float]], off: Sequence[str]) -> dict[str, float]:
        """Returns the values that remain, by name, when parameters that are not in ``off`` go back to their stated values.

        Those in ``off`` then take over the errors of the stated values. So the other parameters go back in turn, the least
        disturbing first, while no value in ``off`` moves by more than √2 of its standard deviations. found: value and
        deviation of each determined parameter, by name."""
        assert self.reduced is not None
        kept = {name: value for name, (value, _) in found.items()}
        while rest := [name for name in kept if name not in off]:
            trials = []
            for back in rest:
                names = [name for name in kept if name != back]
                trial = dict(zip(names, map(float, self.reduced.only(names).step()), strict=True))
                trials.append((max(abs(trial[name] - found[name][0]) / found[name][1] for name in off), trial))
            moved, trial = min(trials, key=lambda one: one[0])
            if moved > _MOST_MOVED:
                break
            kept = trial
        return kept

    def table(self, scan: Scan, corrections: Mapping[str, float]) -> list[ParameterEstimate]:
        """Returns an estimate per parameter in displayed units. corrections: the result of the method ``corrections``, whose
        values replace those found."""
        estimates = {name: (estimate.value, estimate.deviation) for name, estimate in self.fixed.items()} | self.estimates()
        table = []
        for one in self.parameters:
            stated, share = one.stated(scan) * one.scale, self.shares[one.name]
            if one.name not in estimates:
                table.append(ParameterEstimate(one.name, one.unit, stated, None, None, share, CANNOT_TELL))
                continue
            value, deviation = estimates[one.name]
            corrected = corrections.get(one.name, value)
            deviation = math.hypot(deviation, corrected - value)  # other parameters' stated values may be wrong
            found = stated + corrected * one.scale
            verdict = CORRECTED if one.name in corrections else AGREES
            table.append(ParameterEstimate(one.name, one.unit, stated, found, deviation * one.scale, share, verdict))
        return table
