"""Estimates the parameters of single views, or of a motion, from coarse to fine grids."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, Sway, Views
from phyradgs_cl.calibrate.per_view import PerViewParameters, view_deviations, view_step
from phyradgs_cl.calibrate.problem import CoarseProblem
from phyradgs_cl.calibrate.result import AGREES, CORRECTED, ParameterEstimate
from phyradgs_cl.calibrate.stages import PassCounter, Passes, Stage, pass_cost
from phyradgs_cl.runtime import Runtime

DISCRETISATION = 0.5  # fraction of the change since a grid half as fine: the error that remains, if it is of first order
_STEPS = 3
_ITERATIONS = 20
_DEVIATIONS = 3.0  # deviations of one value, which the root mean square of all has to exceed


@dataclass(frozen=True, eq=False)
class ViewsEstimate:
    """``views``: corrections of the kinds that are significant, None without any. ``table``: a line of the table per
    kind."""

    views: Views | Sway | None
    table: list[ParameterEstimate]


def passes_of_views(scan: Scan, stages: Sequence[Stage], kinds: int) -> Passes:
    """Returns the passes through the frames that ``estimate_views`` makes."""
    costs = [pass_cost([scan], stage.columns, scan.frames) for stage in stages]
    counts = [stage.first + (_STEPS - 1) * stage.again + _STEPS * _ITERATIONS for stage in stages]
    counts[-1] += kinds * _ITERATIONS
    return sum(counts), sum(cost * count for cost, count in zip(costs, counts, strict=True))


def estimate_views(
    rt: Runtime, scan: Scan, parameters: PerViewParameters, stages: Sequence[Stage],
    correction: GeometryCorrection, passes: PassCounter,
) -> ViewsEstimate:
    """Estimates ``parameters`` of a scan after ``correction``, in a few Gauss–Newton steps per stage.

    A deviation combines noise and discretisation error, which is half the change since the coarser grid."""
    for number, stage in enumerate(stages):
        problem = CoarseProblem.of(rt, [scan], stage, scan.frames)
        problem = replace(problem, count_pass=passes.counter(pass_cost([scan], stage.columns, scan.frames)))
        former, volume = parameters.values, None
        is_kept = ~np.isin(np.arange(len(parameters.KINDS)), parameters.RESTARTED)
        parameters = replace(parameters, values=former * is_kept)
        kinds = parameters.kinds_of_stage(number, len(stages))
        for _ in range(_STEPS):
            operator = parameters.operator(problem, correction)
            volume = problem.reconstruct(operator, volume, stage.first if volume is None else stage.again)
            step, signals = view_step(problem, correction, parameters, volume, kinds, _ITERATIONS)
            parameters = replace(parameters, values=parameters.without_gauges(parameters.values + step))
    noise, shares = view_deviations(problem, correction, parameters, signals, _ITERATIONS)
    change = _rms_over_views(parameters, parameters.values - former)
    kinds_before = parameters.kinds_of_stage(len(stages) - 2, len(stages)) if len(stages) > 1 else []
    was_estimated = np.isin(np.arange(len(parameters.KINDS)), kinds_before)
    deviations = np.hypot(noise, DISCRETISATION * change * was_estimated)
    sizes = _rms_over_views(parameters, parameters.values)
    is_significant = sizes > _DEVIATIONS * deviations
    table = []
    for k, kind in enumerate(parameters.KINDS):
        size, deviation = float(sizes[k] * kind.scale), float(deviations[k] * kind.scale)
        verdict = CORRECTED if is_significant[k] else AGREES
        table.append(ParameterEstimate(kind.name, kind.unit, 0.0, size, deviation, float(shares[k]), verdict))
    views = parameters.views_of(parameters.values * is_significant) if is_significant.any() else None
    return ViewsEstimate(views, table)


def _rms_over_views(parameters: PerViewParameters, values: np.ndarray) -> np.ndarray:
    """Returns the root mean square (K,) over the views of values (n, K)."""
    return np.sqrt(np.mean(np.square(parameters.basis @ values), 0))
