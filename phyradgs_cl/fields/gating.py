"""Gating: a signal or a phase that states how far the motion of an object is, as a belt, an ECG or a stage records it."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError


@dataclass(frozen=True, eq=False)
class Gating:
    """How far the object's motion is at some times. times_s: (n,) rising, on the clock of ``Scan.frame_start_s``.
    values: (n,) of any unit and sign; with ``is_phase`` phases in cycles, which rise, and whose whole cycles do not count.

    Raises InputError for shapes that differ, values that are not finite, and times that do not rise."""

    times_s: np.ndarray
    values: np.ndarray
    is_phase: bool = False

    def __post_init__(self) -> None:
        times_s = checks.numbers("gating times_s", self.times_s, (None,))
        if len(times_s) == 0 or (np.diff(times_s) <= 0).any():
            raise InputError("gating times_s", checks.short_repr(times_s.tolist()), "at least one time, rising")
        object.__setattr__(self, "times_s", times_s)
        object.__setattr__(self, "values", checks.numbers("gating values", self.values, times_s.shape))

    @property
    def steps(self) -> np.ndarray:
        """By how much each value (n − 1,) is exceeded by the next: from 0 to below 1 of phases."""
        steps = np.diff(self.values)
        return steps % 1.0 if self.is_phase else steps

    def at(self, times_s: np.ndarray) -> np.ndarray:
        """Returns the values (m,) at times (m,), straight between two stated ones; phases may be 1 or more."""
        last = len(self.times_s) - 1
        before = np.clip(np.searchsorted(self.times_s, times_s, "right") - 1, 0, last)
        lengths_s, steps = np.append(np.diff(self.times_s), 1.0), np.append(self.steps, 0.0)
        share = np.clip((np.asarray(times_s) - self.times_s[before]) / lengths_s[before], 0, 1)
        return np.asarray(self.values[before] + share * steps[before])
