"""Every view by itself, or an object that moves slowly, coarse to fine."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.finding import AGREES, CORRECTED, Found
from phyradgs_cl.calibrate.level import Level
from phyradgs_cl.calibrate.moved import Change, Sway, Views
from phyradgs_cl.calibrate.parameters import MOTION, WOBBLE
from phyradgs_cl.calibrate.wobble import (
    KINDS,
    SHIFT_U,
    SHIFT_V,
    TURN,
    Numbers,
    certainty,
    numbers_of_sway,
    numbers_of_views,
    view_step,
    without_gauges,
    without_smooth_gauges,
    without_sway_gauges,
)
from phyradgs_cl.calibrate.work import Work, cost_of
from phyradgs_cl.runtime import Runtime

SPLINES = 7  # of a motion: one for every seventh of the scan, about
_STEPS = 3
_ITERATIONS = 20
_OF_WAY = 0.5  # from a level to one twice as fine: what is left of it, as of an error of first order
_DEVIATIONS = 3.0  # of one value, that all of them have to be off by (root mean square)
_DEG = float(np.rad2deg(1.0))
_OF_VIEWS = (("turn per view", "deg", _DEG), ("shift-v per view", "mm", 1.0), ("shift-u per view", "mm", 1.0))
_OF_OBJECT = tuple(
    (f"{kind} {axis} of the object", unit, scale)
    for kind, unit, scale in (("turn about", "deg", _DEG), ("shift along", "mm", 1.0))
    for axis in "xyz"
)
KINDS_OF = {WOBBLE: len(_OF_VIEWS), MOTION: len(_OF_OBJECT)}
Stages = Sequence[tuple[int, int, int]]


@dataclass(frozen=True, eq=False)
class Wobble:
    """``views``: what was found of the kinds that are off, None where none is; a line of the table per kind."""

    views: Views | Sway | None
    table: list[Found]


def passes_of(scan: Scan, stages: Stages, kinds: int) -> list[tuple[float, int]]:
    """Passes through the frames of looking for so many ``kinds`` of numbers, with their costs."""
    costs = [cost_of([scan], columns, scan.frames) for columns, *_ in stages]
    steps = [first + (_STEPS - 1) * again + _STEPS * _ITERATIONS for _, first, again in stages]
    return [*zip(costs, steps, strict=True), (costs[-1], kinds * _ITERATIONS)]


def find_wobble(rt: Runtime, scan: Scan, stages: Stages, change: Change, work: Work, splines: int = 0) -> Wobble:
    """Turns and shifts of all views of a scan after ``change``, each by itself or by so many ``splines`` of time; stages:
    columns, iterations of a first and next volume.

    Shifts on each level; turns, which need fine detail, on the last two, each time from nothing: how well these agree says
    how sure they are."""
    kinds = [(SHIFT_V, SHIFT_U)] * (len(stages) - 2) + [KINDS] * min(len(stages), 2)
    numbers = numbers_of_views(scan, splines)
    without = partial(without_smooth_gauges, scan, numbers) if splines else partial(without_gauges, scan)
    return _found(rt, scan, stages, change, work, numbers, kinds, without, _OF_VIEWS, (TURN,))


def find_sway(rt: Runtime, scan: Scan, stages: Stages, change: Change, work: Work) -> Wobble:
    """As ``find_wobble``, a rigid motion of the object."""
    kinds = [range(len(_OF_OBJECT))] * len(stages)
    numbers = numbers_of_sway(scan, SPLINES)
    without = partial(without_sway_gauges, scan, numbers)
    return _found(rt, scan, stages, change, work, numbers, kinds, without, _OF_OBJECT)


def _found(
    rt: Runtime,
    scan: Scan,
    stages: Stages,
    change: Change,
    work: Work,
    numbers: Numbers,
    kinds: Sequence[Sequence[int]],
    without: Callable[[np.ndarray], np.ndarray],
    names: Sequence[tuple[str, str, float]],
    anew: Sequence[int] = (),
) -> Wobble:
    """``kinds`` of each stage; ``anew``: those that begin at nothing on each."""
    former = numbers.values
    for (columns, first, again), asked in zip(stages, kinds, strict=True):
        level, volume, former = Level.of(rt, False, [scan], columns, scan.frames), None, numbers.values
        level = replace(level, count_pass=work.counts(cost_of([scan], columns, scan.frames)))
        numbers = replace(numbers, values=former * ~np.isin(np.arange(len(names)), anew))
        for _ in range(_STEPS):
            operator = numbers.operator(level, change)
            volume = level.reconstruct(operator, volume, first if volume is None else again)
            step = view_step(level, change, numbers, volume, asked, _ITERATIONS)
            numbers = replace(numbers, values=without(numbers.values + step.values))
    deviations, shares = certainty(level, change, numbers, step.signals, _ITERATIONS)
    way = np.sqrt(np.mean(np.square(numbers.basis @ (numbers.values - former)), 0))
    told_twice = np.isin(np.arange(len(names)), kinds[-2] if len(stages) > 1 else [])
    deviations = np.hypot(deviations, _OF_WAY * way * told_twice)
    sizes = np.sqrt(np.mean(np.square(numbers.basis @ numbers.values), 0))
    is_off = sizes > _DEVIATIONS * deviations
    table = []
    for kind, (name, unit, scale) in enumerate(names):
        size, deviation = float(sizes[kind] * scale), float(deviations[kind] * scale)
        verdict = CORRECTED if is_off[kind] else AGREES
        table.append(Found(name, unit, 0.0, size, deviation, float(shares[kind]), verdict))
    return Wobble(numbers.views(numbers.values * is_off) if is_off.any() else None, table)
