"""Chooses one number of a method by trials on the scan itself, from the errors at pixels that the trials do not use.

This is cross-validation (``projected.py``) on the scan's own grid, because a coarser grid has another best weight. Held-out
pixels belong to angles that the method has seen: with few views their error is least before the volume is smooth enough.
Of smoothing weights the strongest is therefore chosen whose error is not far above the least. Breiman et al. (Classification
and Regression Trees, 1984) allow a standard error there; this module allows a ratio (docs/results/settings.md)."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, States
from phyradgs_cl.prepare.step import with_masked
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.projected import held_out, holdout_errors
from phyradgs_cl.reconstructors.result import (
    Progress,
    ProgressReport,
    Reconstruction,
    Report,
    ignore_progress,
)
from phyradgs_cl.reconstructors.tune import TUNED, TuningRequest, with_chosen, with_value
from phyradgs_cl.runtime import Runtime

_PERCENT, _SEED = 2.0, 21  # of pixels; not those of --holdout
_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)  # of the present value
_END_FACTOR, _MOST_FURTHER = 4.0, 4  # further values where the choice is at an end
_WEIGHTS = ("tv_weight", "prior_weight", "tv_share")  # of smoothing
_SHORTER = 3  # iterations of the run over those of a trial of weights
_MARGIN, _MARGIN_OF_STOPS = 1.125, 1.5  # of the least squared error beyond the noise (docs/results/settings.md)
_NEXT, _LAST = 1.1, 2  # iterations: the next that is measured over this one, and the last over the best

Run = Callable[..., Reconstruction]
"""(scan, options, report=, resume=) to a result."""


def tuned(
    text: str,
    run: Run,
    scan: Scan,
    options: Any,
    rt: Runtime,
    report: Report,
    resume: State | None = None,
    **extra: Any,
) -> Reconstruction:
    """Runs a method with the number that its trials on ``scan`` choose.

    The facts and the state hold the choice; a resumed run takes it from the state. Raises KeyboardInterrupt for a trial that
    is stopped."""
    request = TuningRequest.parse(text)
    if resume is None:
        tuning = _choose(_Trials(request, run, scan, rt, report, extra), options)
    else:
        tuning = json.loads(str(resume[TUNED]))
        extra["resume"] = {name: array for name, array in resume.items() if name != TUNED}
    tuning_state = {TUNED: np.array(json.dumps(tuning))}
    with report.through(lambda progress: progress.mapped(state=lambda state: {**state, **tuning_state})):
        result = run(scan, with_chosen(options, tuning), report=report, **extra)
    result.facts[TUNED] = tuning
    return result if result.state is None else replace(result, state={**result.state, **tuning_state})


def _choose(trials: "_Trials", options: Any) -> dict[str, Any]:
    """Runs the trials. Returns the choice with the tried values and their errors, as facts."""
    started = time.perf_counter()
    if trials.option == "iterations":
        trials.follow(with_chosen(options, {"option": trials.option, "chosen": options.iterations}))
    else:
        trials.compare(options)
    values = sorted(trials.errors)
    return {
        "option": trials.option, "chosen": trials.choice, "values": values,
        "holdout_rms": [trials.errors[value] for value in values], "holdout_noise_rms": trials.noise_rms,
        "holdout_pixels": int(trials.held.sum()), "seconds": time.perf_counter() - started,
    }  # fmt: skip


class _Trials:
    """Runs of a method on a scan without some of its pixels. ``errors``: the RMS at these pixels by value."""

    def __init__(
        self, request: TuningRequest, run: Run, scan: Scan, rt: Runtime, report: Report, extra: Mapping[str, Any]
    ) -> None:
        self.option, self.values = request.option, request.values
        self.run, self.scan, self.rt, self.report, self.extra = run, scan, rt, report, extra
        self.held = held_out(scan, _PERCENT, _SEED, "--tune")
        self.visible = with_masked(scan, self.held)
        self.errors: dict[float, float] = {}
        self.noise_rms = 0.0

    @property
    def choice(self) -> float:
        """The best value by the errors so far."""
        values = np.array(sorted(self.errors), np.float64)
        errors = np.array([self.errors[value] for value in sorted(self.errors)])
        excess = np.maximum(errors**2 - self.noise_rms**2, 0)
        if self.option in _WEIGHTS:
            best = _last_within(values, excess, _MARGIN)
        elif self.option == "iterations":
            best = _last_within(values[::-1], excess[::-1], _MARGIN_OF_STOPS)
        else:
            best = _parabola_minimum(values, errors)
        return round(best) if isinstance(min(self.errors), int) else best

    def compare(self, options: Any) -> None:
        """Measures the errors of runs at the requested values, or at some around the present one.

        The latter are extended where the choice is at an end, but not for whole numbers, with which runs may take longer.
        Trials of weights are shorter: a weight is as good there, which does not hold for a relaxation."""
        if self.option in _WEIGHTS and hasattr(options, "iterations"):
            options = replace(options, iterations=ceil_div(options.iterations, _SHORTER))
        present = getattr(options, self.option)
        self._try(options, self.values or [factor * present for factor in _FACTORS])
        for _ in range(0 if self.values or isinstance(present, int) else _MOST_FURTHER):
            values = sorted(self.errors)
            if self.choice >= values[-1]:
                self._try(options, [_END_FACTOR * values[-1]])
            elif self.choice < values[1]:
                self._try(options, [values[0] / _END_FACTOR])

    def follow(self, options: Any) -> None:
        """Measures the errors in the course of one run, which ends long after the least error."""
        latest, is_past = 0, False

        def measure(progress: Progress) -> None:
            nonlocal latest, is_past
            if progress.volume is None or progress.iteration < min(_NEXT * latest, progress.iterations):
                return
            latest = progress.iteration
            self._measure(latest, *progress.volume(), progress.deformation)
            is_past = latest > _LAST * min(self.errors, key=self.errors.__getitem__) + 1
            if is_past:
                raise KeyboardInterrupt

        result = self._run(options, measure)
        self.errors, self.noise_rms, is_past = self.rt.ranks.bcast((self.errors, self.noise_rms, is_past))
        if result.facts["interrupted_at"] is not None and not is_past:
            raise KeyboardInterrupt

    def _try(self, options: Any, values: Sequence[float]) -> None:
        for value in values:
            try:
                trial_options = with_value(options, self.option, value)
            except InputError:  # outside the option's range
                continue
            value = getattr(trial_options, self.option)
            if value in self.errors:  # two values round to one whole number
                continue
            result = self._run(trial_options)
            if result.facts.get("interrupted_at") is not None:
                raise KeyboardInterrupt
            if self.rt.ranks.rank == 0:
                self._measure(value, result.volume, result.grid, result.moves)
            self.errors, self.noise_rms = self.rt.ranks.bcast((self.errors, self.noise_rms))

    def _run(self, options: Any, measure: ProgressReport = ignore_progress) -> Reconstruction:
        """Runs a trial, which is reported as one and leaves no checkpoint."""
        words = f"{self.option} {getattr(options, self.option):.4g} on trial: "

        def hook(progress: Progress) -> Progress:
            measure(progress)
            return replace(progress, quantity=words + progress.quantity, state=None, volume=None)

        with self.report.through(hook):
            return self.run(self.visible, options, report=self.report, **self.extra)

    def _measure(self, value: float, volume: np.ndarray, grid: Grid, found: Deformation | States | None) -> None:
        """Adds the error of a volume whose object moves as the run found, or by a field that it was given."""
        moves = found or self.extra.get("deformation")
        errors = holdout_errors(self.rt, self.scan, self.held, volume, grid, moves)
        self.errors[value], self.noise_rms = errors["holdout_rms"], errors["holdout_noise_rms"]


def _last_within(values: np.ndarray, errors: np.ndarray, margin: float) -> float:
    """Returns the last of values (n,), interpolated, at which errors (n,) are at most ``margin`` times their minimum."""
    limit = margin * errors.min()
    within = int(np.flatnonzero(errors <= limit)[-1])
    if within == len(values) - 1:
        return float(values[-1])
    share = (limit - errors[within]) / (errors[within + 1] - errors[within])
    low, high = values[within : within + 2]
    return float(low ** (1 - share) * high**share) if low > 0 else float(share * high)


def _parabola_minimum(values: np.ndarray, errors: np.ndarray) -> float:
    """Returns the minimum of the parabola through the least of errors (n,) and its neighbours, over ln(values)."""
    best = int(errors.argmin())
    if best in (0, len(values) - 1) or values[best - 1] <= 0:
        return float(values[best])
    a, b, _ = np.polyfit(np.log(values[best - 1 : best + 2]), errors[best - 1 : best + 2], 2)
    return float(np.exp(-b / (2 * a)))
