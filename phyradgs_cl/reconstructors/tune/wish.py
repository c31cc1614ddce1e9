"""Which option the scan is to choose, and options with what it has chosen."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.text import near_miss

_STOPS = "its short runs are not the beginnings of long ones; set --iterations"


@dataclass(frozen=True)
class Wish:
    """The option to be chosen, and the values to be tried; none: some about the present one."""

    option: str
    values: tuple[float, ...] = ()


def wish_of(text: str) -> Wish:
    """NAME, or NAME=VALUE,VALUE,VALUE. Raises InputError for other texts."""
    name, sign, rest = text.partition("=")
    expected = "NAME of an option, or NAME=VALUE,VALUE,VALUE"
    if not name.strip():
        raise InputError("--tune", repr(text), expected, "write for example --tune prior_weight")
    try:
        values = sorted({float(part) for part in rest.split(",")}) if sign else []
    except ValueError:
        raise InputError("--tune", f"{rest!r} for {name}", "numbers with commas between") from None
    if not np.isfinite(values).all() or (sign and len(values) < 3):
        raise InputError("--tune", f"{rest!r} for {name}", "three different finite numbers or more")
    return Wish(name.strip(), tuple(values))


def check_wish(text: str, method: str, options: Any, changes: Mapping[str, Any], ends_anywhere: bool) -> None:
    """InputError for an option that cannot be chosen, or that the user has chosen. ends_anywhere: whether the method's short
    runs are the beginnings of its long ones."""
    wish = wish_of(text)
    name = wish.option
    numbers = [f.name for f in fields(options) if checks.is_number(getattr(options, f.name))]
    if not ends_anywhere:
        numbers = [number for number in numbers if number != "iterations"]
    if name not in numbers:
        expected = f"one of {', '.join(numbers)}" if numbers else "a method with numbers to choose"
        remedy = near_miss(name, numbers, "leave --tune out") if name != "iterations" else _STOPS
        raise InputError("--tune", f"{name}, no number to choose of --method {method}", expected, remedy)
    if not wish.values and getattr(options, name) == 0:
        remedy = f"--{name} N" if name == "iterations" else f"--tune {name}=A,B,C"
        raise InputError("--tune", f"{name}, which is 0: there is nothing to try about it", "another value", remedy)
    if name == "iterations":
        if wish.values:
            remedy = "--iterations N says how many at most"
            raise InputError("--tune", "values of iterations", "none: every iteration is looked at", remedy)
        return
    if name in changes:
        remedy = f"leave one of the two out, or try values: --tune {name}=A,B,C"
        raise InputError("--tune", f"{name}, which is set to {checks.shown(changes[name])}", "one choice", remedy)
    for value in wish.values:
        if isinstance(getattr(options, name), int) and value != round(value):
            raise InputError("--tune", f"{name} = {value:g}", "whole numbers")
        try:
            with_value(options, name, value)
        except InputError as error:
            raise InputError("--tune", f"{name} = {error.found}", error.expected) from error


def with_chosen(options: Any, found: Mapping[str, Any]) -> Any:
    """The options with what was chosen, as facts say it; where iterations were, the residual no longer ends the run."""
    name, value = found["option"], found["chosen"]
    ends = {"noise_stop": 0.0} if name == "iterations" and getattr(options, "noise_stop", 0) else {}
    return replace(with_value(options, name, value), **ends)


def is_told(found: object) -> bool:
    """Whether facts say in numbers what was chosen, and from what: files are written by strangers, too."""
    if not isinstance(found, Mapping) or not isinstance(found.get("option"), str):
        return False
    values, errors = found.get("values"), found.get("holdout_rms")
    if not (isinstance(values, list) and isinstance(errors, list) and len(values) == len(errors) > 0):
        return False
    others = [found.get(name) for name in ("chosen", "holdout_noise_rms", "seconds")]
    return all(map(checks.is_number, [*values, *errors, *others]))


def with_value(options: Any, name: str, value: float) -> Any:
    """The options with one of their numbers changed, rounded where it is a whole one."""
    kind = type(getattr(options, name))
    return replace(options, **{name: round(value) if kind is int else kind(value)})
