"""The search for the parameters that all views share: Gauss–Newton steps from coarse to fine grids.

On each grid a volume is reconstructed, and the signals that a volume explains are removed (``reduced``). The parameters then
step until the steps are small. On the first grid each step decides which parameters the frames determine."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.beads import BeadProblem
from phyradgs_cl.calibrate.parameters import GAUGES, PARAMETERS, Parameter, correction_of, in_words
from phyradgs_cl.calibrate.problem import CoarseProblem
from phyradgs_cl.calibrate.reduced import (
    LEAST_SHARE_OF_BEADS,
    Reduced,
    indistinguishable,
    least_shares,
    reduced,
)
from phyradgs_cl.calibrate.result import AGREES, CANNOT_TELL, CORRECTED, ParameterEstimate
from phyradgs_cl.calibrate.stages import Stage
from phyradgs_cl.calibrate.views import DISCRETISATION

DEVIATIONS = 3.0  # deviations by which a parameter has to differ from its stated value
_MOST_PX = 2.0  # largest step, in pixels of the grid: signals are not linear beyond
_SETTLED = 0.1  # largest last step, in standard deviations

Problem = CoarseProblem | BeadProblem


@dataclass(frozen=True)
class Fallback:
    """A parameter's value less the stated value, and its standard deviation, in the field's unit."""

    value: float
    deviation: float
    is_significant: bool

    @property
    def correction(self) -> float:
        return self.value if self.is_significant else 0.0


@dataclass(eq=False)
class Search:
    """The state of a search.

    - at: the current values by name. former: those at the end of the previous grid, which shows the error of the voxels.
    - determined: the parameters that the frames determine, None before the first step.
    - fallback: estimates from elsewhere, for parameters that are not determined. fixed: those of them in use.
    - held: parameters that fits do not determine, because wrong values fit better.
    - shares: the part of each signal that remains. alike: combinations, in words, that no frame distinguishes.
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
        """Steps on one grid until the steps are small."""
        volume: np.ndarray | None = None
        asks = self.determined is None
        self.former = {} if asks or isinstance(problem, BeadProblem) else dict(self.at)
        for number in range(stage.steps):
            parameters = self.parameters if asks else [PARAMETERS[name] for name in self.determined or ()]
            operator: Any = problem.operator(correction_of(self.at))
            volume = problem.reconstruct(operator, volume, stage.again if number else stage.first)
            more = GAUGES if asks and isinstance(problem, CoarseProblem) else ()
            linear = reduced(problem, operator, [*parameters, *more], self.at, volume, stage.project)
            if asks:
                self._decide_determined(linear)
            assert self.determined is not None
            self.reduced = linear.relative_to_stated(self.at).only(self.determined)
            if not self.determined or self._step(problem):
                return

    def _decide_determined(self, linear: Reduced) -> None:
        """Decides which parameters the frames determine: those with a large enough share and a useful deviation."""
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

    def _step(self, problem: Problem) -> bool:
        """Moves the determined parameters, each as far as its signal is linear. Returns True where the step was small."""
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
        """Leaves only the held parameters estimated."""
        self.determined = ()
        self.fixed = {name: estimate for name, estimate in self.fixed.items() if name in self.held}

    def estimates(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the values of the determined parameters and their standard deviations.

        A deviation combines noise and discretisation error, which is half the change since the coarser grid. Both grow where
        a parameter resembles undetermined ones, which stay as stated, right or wrong."""
        if self.reduced is None or not self.determined:
            return np.zeros(0), np.zeros(0)
        values, noise = self.reduced.step(), self.reduced.deviations()
        change = values - [self.former.get(name, value) for name, value in zip(self.determined, values, strict=True)]
        resemblance = np.maximum(self.reduced.shares / [self.shares[name] for name in self.determined], 1.0)
        return values, resemblance * np.hypot(noise, DISCRETISATION * change)

    def corrections(self) -> dict[str, float]:
        """Returns the values of the parameters that differ from the stated ones by three deviations.

        The others go back to their stated values. That changes the remaining ones, so this repeats until all of those
        differ."""
        values, deviations = self.estimates()
        deviation = dict(zip(self.determined or (), deviations, strict=True))
        names = self.determined or ()
        while self.reduced is not None and names:
            is_off = [abs(value) > DEVIATIONS * deviation[name] for name, value in zip(names, values, strict=True)]
            if all(is_off):
                break
            names = tuple(name for name, off in zip(names, is_off, strict=True) if off)
            values = self.reduced.only(names).step() if names else values[:0]
        significant = {name: estimate.correction for name, estimate in self.fixed.items() if estimate.is_significant}
        return significant | dict(zip(names, map(float, values), strict=True))

    def table(self, scan: Scan, corrections: Mapping[str, float]) -> list[ParameterEstimate]:
        """Returns an estimate per parameter. Those in ``corrections`` have these values."""
        values, deviations = self.estimates()
        estimates = {name: (estimate.value, estimate.deviation) for name, estimate in self.fixed.items()}
        estimates |= dict(zip(self.determined or (), zip(values.tolist(), deviations.tolist(), strict=True), strict=True))
        table = []
        for one in self.parameters:
            stated, share = one.stated(scan) * one.scale, self.shares[one.name]
            if one.name not in estimates:
                table.append(ParameterEstimate(one.name, one.unit, stated, None, None, share, CANNOT_TELL))
                continue
            value, deviation = estimates[one.name]
            found = stated + corrections.get(one.name, value) * one.scale
            verdict = CORRECTED if one.name in corrections else AGREES
            table.append(ParameterEstimate(one.name, one.unit, stated, found, deviation * one.scale, share, verdict))
        return table
