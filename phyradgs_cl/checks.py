"""Checks for the public doors: each raises InputError with the culprit's name, or returns nothing."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from phyradgs_cl.errors import InputError


def positive(culprit: str, value: float) -> None:
    """Raise InputError unless the scalar `value` is finite and above zero."""
    if not (_is_number(value) and math.isfinite(value) and value > 0):
        raise InputError(culprit, repr(value), "a finite number above 0")


def at_least(culprit: str, value: float, minimum: float) -> None:
    """Raise InputError unless the scalar `value` is finite and not below `minimum`."""
    if not (_is_number(value) and math.isfinite(value) and value >= minimum):
        raise InputError(culprit, repr(value), f"a finite number, at least {minimum}")


def within(culprit: str, value: float, lowest: float, highest: float) -> None:
    """Raise InputError unless the scalar `value` is finite and between two bounds, both included."""
    if not (_is_number(value) and math.isfinite(value) and lowest <= value <= highest):
        raise InputError(culprit, repr(value), f"a number from {lowest} to {highest}")


def one_of(culprit: str, value: object, allowed: Iterable[object]) -> None:
    """Raise InputError unless `value` is among `allowed`, which the message lists."""
    choices = list(allowed)
    if value not in choices:
        raise InputError(culprit, repr(value), "one of " + ", ".join(repr(choice) for choice in choices))


def finite(culprit: str, array: ArrayLike) -> None:
    """Raise InputError if any element of `array` (any shape) is NaN or infinite; names the first."""
    good = np.isfinite(np.asarray(array))
    if not good.all():
        count = int(good.size - np.count_nonzero(good))
        first = tuple(int(i) for i in np.unravel_index(int(np.argmin(good)), good.shape))
        raise InputError(culprit, f"{count} NaN or infinite values, first at {first}", "finite values")


def shape(culprit: str, array: ArrayLike, expected: Sequence[int | None]) -> None:
    """Raise InputError unless `array` has the shape `expected`, in which None stands for any length."""
    found = np.shape(array)
    fits = len(found) == len(expected) and all(e in (None, f) for f, e in zip(found, expected, strict=True))
    if not fits:
        wanted = ", ".join("any" if e is None else str(e) for e in expected)
        raise InputError(culprit, f"shape {found}", f"shape ({wanted})")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
