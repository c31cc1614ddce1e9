"""An option of a method chosen from the scan: which option, which values, and options with the chosen value."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.text import suggest_name

TUNED = "tuned"
"""The key of facts and states that holds the chosen value and the errors of the trials."""


@dataclass(frozen=True)
class TuningRequest:
    """The option to be chosen, and the values to try; none: some around its present value."""

    option: str
    values: tuple[float, ...] = ()

    @classmethod
    def parse(cls, text: str) -> "TuningRequest":
        """Reads NAME, or NAME=VALUE,VALUE,VALUE. Raises InputError for other texts."""
        name, sign, rest = text.partition("=")
        if not name.strip():
            expected = "NAME of an option, or NAME=VALUE,VALUE,VALUE"
            raise InputError("--tune", repr(text), expected, "write for example --tune prior_weight")
        try:
            values = sorted({float(part) for part in rest.split(",")}) if sign else []
        except ValueError:
            raise InputError("--tune", f"{rest!r} for {name}", "numbers with commas between") from None
        if not np.isfinite(values).all() or (sign and len(values) < 3):
            raise InputError("--tune", f"{rest!r} for {name}", "three different finite numbers or more")
        return cls(name.strip(), tuple(values))


def check_tuning(text: str, method: str, options: Any, changes: Mapping[str, Any], ends_anywhere: bool) -> None:
    """Raises InputError for an option that cannot be chosen, or that the user has set.

    ends_anywhere: whether the method's short runs are the beginnings of its long ones."""
    request = TuningRequest.parse(text)
    name = request.option
    numbers = [f.name for f in fields(options) if checks.is_number(getattr(options, f.name))]
    if not ends_anywhere:
        numbers = [number for number in numbers if number != "iterations"]
    if name not in numbers:
        expected = f"one of {', '.join(numbers)}" if numbers else "a method with numbers to choose"
        remedy = suggest_name(name, numbers, "leave --tune out")
        if name == "iterations":
            remedy = "its short runs are not the beginnings of long ones; set --iterations"
        raise InputError("--tune", f"{name}, no number to choose of --method {method}", expected, remedy)
    if not request.values and getattr(options, name) == 0:
        remedy = f"--{name} N" if name == "iterations" else f"--tune {name}=A,B,C"
        raise InputError("--tune", f"{name}, which is 0: there is nothing to try about it", "another value", remedy)
    if name == "iterations" and request.values:
        remedy = "--iterations N says how many at most"
        raise InputError("--tune", "values of iterations", "none: every iteration is looked at", remedy)
    if name in changes and name != "iterations":
        remedy = f"leave one of the two out, or try values: --tune {name}=A,B,C"
        raise InputError("--tune", f"{name}, which is set to {checks.short_repr(changes[name])}", "one choice", remedy)
    for value in request.values:
        if isinstance(getattr(options, name), int) and value != round(value):
            raise InputError("--tune", f"{name} = {value:g}", "whole numbers")
        try:
            with_value(options, name, value)
        except InputError as error:
            raise InputError("--tune", f"{name} = {error.found}", error.expected) from error


def with_value(options: Any, name: str, value: float) -> Any:
    """Returns the options with another value of one number, rounded where it is a whole number."""
    kind = type(getattr(options, name))
    return replace(options, **{name: round(value) if kind is int else kind(value)})


def with_chosen(options: Any, tuning: Mapping[str, Any]) -> Any:
    """Returns the options with the chosen value. With chosen iterations the residual no longer ends the run."""
    options = with_value(options, tuning["option"], tuning["chosen"])
    if tuning["option"] == "iterations" and getattr(options, "noise_stop", 0):
        return replace(options, noise_stop=0.0)
    return options


def is_tuning(facts: object) -> bool:
    """Whether facts, which may come from any file, hold a chosen value and the errors of the trials as numbers."""
    if not isinstance(facts, Mapping) or not isinstance(facts.get("option"), str):
        return False
    values, errors = facts.get("values"), facts.get("holdout_rms")
    if not (isinstance(values, list) and isinstance(errors, list) and len(values) == len(errors) > 0):
        return False
    others = [facts.get(name) for name in ("chosen", "holdout_noise_rms", "seconds")]
    return all(map(checks.is_number, [*values, *errors, *others]))


def tuning_line(tuning: Mapping[str, Any]) -> str:
    """Returns one line on the chosen value and the trials."""
    tried = f"chosen from {tuning['values'][0]:.4g} to {tuning['values'][-1]:.4g} in {tuning['seconds']:.1f} s"
    error = f"held-out pixels {min(tuning['holdout_rms']):.4g} RMS at best (noise {tuning['holdout_noise_rms']:.4g})"
    return f"{tuning['option']} {tuning['chosen']:.4g}, {tried}: {error}"
