"""Every view by itself, coarse to fine: shifts on each level, turns, which need fine detail, on the last one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.calibrate.finding import AGREES, CORRECTED, Found
from phyradgs_cl.calibrate.level import Level
from phyradgs_cl.calibrate.moved import Change, Views
from phyradgs_cl.calibrate.wobble import KINDS, SHIFT_U, SHIFT_V, view_step, views_of, without_gauges
from phyradgs_cl.runtime import Runtime

_STEPS = 3
_ITERATIONS = 20
_DEVIATIONS = 2.0  # of one view, that all of them have to be off by (root mean square)
_NAMES = (("turn per view", "deg", np.rad2deg(1.0)), ("shift-v per view", "mm", 1.0), ("shift-u per view", "mm", 1.0))


@dataclass(frozen=True, eq=False)
class Wobble:
    """``views``: what was found of the kinds that are off, None where none is; a line of the table per kind."""

    views: Views | None
    table: list[Found]


def find_wobble(rt: Runtime, scan: Scan, stages: Sequence[tuple[int, int, int]], change: Change) -> Wobble:
    """Turns and shifts of all views of a scan after ``change``; stages: columns, iterations of a first and next volume."""
    numbers = np.zeros((scan.frames, len(KINDS)))
    for number, (columns, first, again) in enumerate(stages):
        level, volume = Level.of(rt, [scan], columns, scan.frames), None
        kinds = KINDS if number == len(stages) - 1 else (SHIFT_V, SHIFT_U)
        for _ in range(_STEPS):
            operator = level.operator(change, views_of(numbers))
            volume = level.reconstruct(operator, volume, first if volume is None else again)
            step = view_step(level, change, numbers, volume, kinds, _ITERATIONS)
            numbers = without_gauges(scan, numbers + step.numbers)
    sizes = np.sqrt(np.mean(np.square(numbers), 0))
    is_off = sizes > _DEVIATIONS * step.deviations
    table = []
    for kind, (name, unit, scale) in zip(KINDS, _NAMES, strict=True):
        size, deviation = float(sizes[kind] * scale), float(step.deviations[kind] * scale)
        verdict = CORRECTED if is_off[kind] else AGREES
        table.append(Found(name, unit, 0.0, size, deviation, float(step.shares[kind]), verdict))
    return Wobble(views_of(numbers * is_off) if is_off.any() else None, table)
