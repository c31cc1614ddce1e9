"""A number of a method chosen from the scan: by pixels that trials of the method do not see.

Cross-validation (``holdout.py``) on the scan's own grid: the best weight of a coarser one is another. Pixels tell of angles
that a method has seen: where views are few their error is least before the volume is smooth enough. So of what smooths, the
strongest is taken whose error is not far above the least (as in Breiman et al., Classification and Regression Trees, 1984,
with a share in place of their standard error; docs/results/settings.md).
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.step import with_masked
from phyradgs_cl.reconstructors.checkpoint import parsed
from phyradgs_cl.reconstructors.frames.holdout import held_out, holdout_errors
from phyradgs_cl.reconstructors.result import (
    Progress,
    ProgressReport,
    Reconstruction,
    Report,
    State,
    ignore_progress,
)
from phyradgs_cl.reconstructors.tune.wish import Wish, is_told, wish_of, with_chosen, with_value
from phyradgs_cl.runtime import Runtime

TUNED = "tuned"
"""Where facts and states have what was chosen."""
_PERCENT, _SEED = 2.0, 21  # of pixels; others than those of --holdout
_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
_FURTHER, _MOST_FURTHER = 4.0, 4  # beyond an end of these, if the choice is there
_WEIGHTS = ("tv_weight", "prior_weight", "tv_share")  # of what smooths
_SHORTER = 3  # trials of weights have so many times fewer iterations
_MARGIN, _MARGIN_OF_STOPS = 1.125, 1.5  # of the least squared error beyond the noise (docs/results/settings.md)
_LATER, _PAST = 1.1, 2  # iterations: the next that is looked at, and the last, as multiples of this one and of the best

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
    """The run of a method with the number that its trials on ``scan`` speak for; what was chosen, and from what, stands in
    its facts and in its state, from which a run that goes on takes it. Raises KeyboardInterrupt for a trial that is stopped.
    """
    wish = wish_of(text)
    found = _chosen(wish, run, scan, options, rt, report, extra) if resume is None else _kept(resume, wish.option)
    kept = {TUNED: np.array(json.dumps(found))}
    if resume is not None:
        extra["resume"] = {name: array for name, array in resume.items() if name != TUNED}
    with report.through(lambda progress: progress.mapped(state=lambda state: {**state, **kept})):
        result = run(scan, with_chosen(options, found), report=report, **extra)
    result.facts[TUNED] = found
    return result if result.state is None else replace(result, state={**result.state, **kept})


def tuned_words(found: Mapping[str, Any]) -> str:
    """What was chosen, in a line."""
    tried = f"chosen from {found['values'][0]:.4g} to {found['values'][-1]:.4g} in {found['seconds']:.1f} s"
    error = f"held-out pixels {min(found['holdout_rms']):.4g} RMS at best (noise {found['holdout_noise_rms']:.4g})"
    return f"{found['option']} {found['chosen']:.4g}, {tried}: {error}"


def _kept(state: State, option: str) -> dict[str, Any]:
    found = parsed(state, TUNED, dict)
    if not is_told(found) or found["option"] != option:
        raise InputError(f"checkpoint, array {TUNED}", "no choice", "what a run has written", "start without --resume")
    return found


def _chosen(
    wish: Wish, run: Run, scan: Scan, options: Any, rt: Runtime, report: Report, extra: Mapping[str, Any]
) -> dict[str, Any]:
    """What is chosen, as facts: the values tried and the error at each."""
    started = time.perf_counter()
    trials = _Trials(wish.option, run, scan, rt, report, extra)
    if wish.option == "iterations":
        trials.follow(with_chosen(options, {"option": wish.option, "chosen": options.iterations}))
    else:
        trials.compare(options, wish.values)
    tried = sorted(trials.errors)
    return {
        "option": wish.option,
        "chosen": trials.choice,
        "values": tried,
        "holdout_rms": [trials.errors[value] for value in tried],
        "holdout_noise_rms": trials.noise_rms,
        "holdout_pixels": int(trials.held.sum()),
        "seconds": time.perf_counter() - started,
    }


class _Trials:
    """Runs of a method on a scan without some of its pixels; ``errors``: RMS on these by value."""

    def __init__(
        self, option: str, run: Run, scan: Scan, rt: Runtime, report: Report, extra: Mapping[str, Any]
    ) -> None:
        self.option, self.run, self.scan, self.rt, self.report, self.extra = option, run, scan, rt, report, extra
        self.held = held_out(scan, _PERCENT, _SEED, "--tune")
        self.seen = with_masked(scan, self.held)
        self.errors: dict[float, float] = {}
        self.noise_rms = 0.0

    @property
    def choice(self) -> float:
        """What the errors so far speak for."""
        tried = sorted(self.errors)
        values, errors = np.array(tried, np.float64), np.array([self.errors[value] for value in tried])
        beyond = np.maximum(errors**2 - self.noise_rms**2, 0)
        if self.option in _WEIGHTS:
            found = _furthest(values, beyond, _MARGIN)
        elif self.option == "iterations":
            found = _furthest(values[::-1], beyond[::-1], _MARGIN_OF_STOPS)
        else:
            found = _least(values, errors)
        return round(found) if isinstance(tried[0], int) else found

    def compare(self, options: Any, values: Sequence[float]) -> None:
        """Errors of runs at ``values``; or at some about the present one, and further on where the choice is at an end, but
        for whole numbers, with which runs may grow. Smoothing is as good in shorter runs; how far a relaxation goes they
        would not tell."""
        if self.option in _WEIGHTS and hasattr(options, "iterations"):
            options = replace(options, iterations=-(-options.iterations // _SHORTER))
        self._try(options, values or [factor * getattr(options, self.option) for factor in _FACTORS])
        for _ in range(0 if values or isinstance(getattr(options, self.option), int) else _MOST_FURTHER):
            tried = sorted(self.errors)
            if self.choice >= tried[-1]:
                self._try(options, [_FURTHER * tried[-1]])
            elif self.choice < tried[1]:
                self._try(options, [tried[0] / _FURTHER])

    def follow(self, options: Any) -> None:
        """Errors in the course of one run, which is ended where they are long past the least."""
        latest, is_past = 0, False

        def look(progress: Progress) -> None:
            nonlocal latest, is_past
            if progress.volume is None or progress.iteration < min(_LATER * latest, progress.iterations):
                return
            latest = progress.iteration
            self._measure(latest, Reconstruction(*progress.volume()))
            is_past = latest > _PAST * min(self.errors, key=self.errors.__getitem__) + 1
            if is_past:
                raise KeyboardInterrupt

        result = self._run(options, look)
        self.errors, self.noise_rms, is_past = self.rt.ranks.bcast((self.errors, self.noise_rms, is_past))
        if result.facts["interrupted_at"] is not None and not is_past:
            raise KeyboardInterrupt

    def _try(self, options: Any, values: Sequence[float]) -> None:
        for value in values:
            try:
                some = with_value(options, self.option, value)
            except InputError:  # beyond what the method takes
                continue
            value = getattr(some, self.option)
            if value in self.errors:  # of whole numbers
                continue
            result = self._run(some)
            if result.facts.get("interrupted_at") is not None:
                raise KeyboardInterrupt
            if self.rt.ranks.rank == 0:
                self._measure(value, result)
            self.errors, self.noise_rms = self.rt.ranks.bcast((self.errors, self.noise_rms))

    def _run(self, options: Any, look: ProgressReport = ignore_progress) -> Reconstruction:
        """A trial, which reports in the words of one, and leaves nothing to go on from."""
        words = f"{self.option} {getattr(options, self.option):.4g} on trial: "

        def hook(progress: Progress) -> Progress:
            look(progress)
            return replace(progress, quantity=words + progress.quantity, state=None, volume=None)

        with self.report.through(hook):
            return self.run(self.seen, options, report=self.report, **self.extra)

    def _measure(self, value: float, result: Reconstruction) -> None:
        found = holdout_errors(self.rt, self.scan, self.held, result)
        self.errors[value], self.noise_rms = found["holdout_rms"], found["holdout_noise_rms"]


def _furthest(values: np.ndarray, beyond: np.ndarray, margin: float) -> float:
    """The last of values (n,), between them too, at which ``beyond`` (n,) is at most ``margin`` times its least."""
    limit = margin * beyond.min()
    within = int(np.flatnonzero(beyond <= limit)[-1])
    if within == len(values) - 1:
        return float(values[-1])
    share = (limit - beyond[within]) / (beyond[within + 1] - beyond[within])
    low, high = values[within : within + 2]
    return float(low ** (1 - share) * high**share) if low > 0 else float(share * high)


def _least(values: np.ndarray, errors: np.ndarray) -> float:
    """Where a parabola through the least of errors (n,) and those beside it is least, over the logarithm of values (n,)."""
    best = int(errors.argmin())
    if best in (0, len(values) - 1) or values[best - 1] <= 0:
        return float(values[best])
    a, b, _ = np.polyfit(np.log(values[best - 1 : best + 2]), errors[best - 1 : best + 2], 2)
    return float(np.exp(-b / (2 * a)))
