"""A method: a function ``(scan, options, rt, *, seed, report, resume)``, of the package's or of somebody's own.

One's own needs no more than ``(scan, options, rt)``, of which ``options`` may be annotated with a dataclass: its fields
are then what ``--set`` and ``reconstruct`` take. It gives a ``Reconstruction``, or a volume (nz, ny, nx) in 1/mm on the
scan's grid.
"""

import importlib
import inspect
import operator
import os
import sys
import time
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass, replace
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan, Static
from phyradgs_cl.errors import InputError, NumericalError
from phyradgs_cl.reconstructors.result import Reconstruction, option_facts
from phyradgs_cl.runtime import Runtime

_FORM = "a function (scan, options, rt, …)"


@dataclass(frozen=True)
class Method:
    """A reconstruction method: its function, and its presets of options, of which the first is the default.

    is_resumable: it has checkpoints. is_shared: several ranks can share its work. takes_initial: it can start from a volume.
    ends_anywhere: its short runs are the beginnings of its long ones.
    """

    run: Callable[..., Reconstruction]
    presets: Mapping[str, Any]
    is_resumable: bool = True
    is_shared: bool = False
    takes_initial: bool = False
    ends_anywhere: bool = False


@dataclass(frozen=True)
class OwnOptions:
    """What a function that says nothing of its options can be told: the motion model."""

    motion: Motion = Static()


def own_method(name: str, function: Any) -> Method:
    """A function of somebody's own as a method, whose options are the defaults of their class.

    Raises InputError for what is no such function, or options that need a value.
    """
    subject = f"--method {name}"
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError):
        raise InputError(subject, checks.short_repr(function), _FORM) from None
    by_place = [p for p in parameters.values() if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if len(by_place) < 3:
        raise InputError(subject, f"{function!r} with {len(by_place)} parameters", _FORM)
    takes_all = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    takes = {key for key in ("seed", "report", "resume") if takes_all or key in parameters}

    is_asked = "resume" in parameters and parameters["resume"].default is inspect.Parameter.empty
    without = {"resume": None} if is_asked else {}

    def run(scan: Scan, options: Any, rt: Runtime, **given: Any) -> Reconstruction:
        started = time.perf_counter()
        told = {**without, **given}
        made = function(scan, options, rt, **{key: value for key, value in told.items() if key in takes})
        seconds = time.perf_counter() - started
        facts = {"method": name, "options": _plain(option_facts(options)), "seconds": seconds}
        result = _result(subject, made, scan)
        return replace(result, facts={**facts, **result.facts})

    presets = {"default": _default_options(subject, function, by_place[1])}
    return Method(run, presets, is_resumable="resume" in takes)


def imported(text: str, subject: str = "--method") -> Any:
    """What ``package.module:name`` names, found as by ``python -m`` in the present folder too."""
    module, _, name = text.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        remedy = "start in its folder, or add that to PYTHONPATH"
        raise InputError(subject, f"{text}: {error}", "package.module:function", remedy) from error
    except Exception as error:  # whatever a module does as it is imported
        found_there = f"{text}: {type(error).__name__}: {error}"
        raise InputError(subject, found_there, "a module that can be imported") from error
    try:
        return operator.attrgetter(name)(found)
    except AttributeError:
        raise InputError(subject, text, f"a function {name} in {module}") from None


def _plain(value: Any) -> Any:
    """A fact as files keep it: what JSON has no word for as Python prints it."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    return value if isinstance(value, int | float | str | None) else repr(value)


def _default_options(subject: str, function: Any, parameter: inspect.Parameter) -> Any:
    """The options of a function as they are by themselves."""
    try:
        kind = typing.get_type_hints(function).get(parameter.name)
    except (NameError, TypeError):  # annotations of what is not there when it runs
        kind = None
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return OwnOptions()
    try:
        return kind()
    except TypeError as error:
        raise InputError(subject, f"{kind.__name__}: {error}", "options that all have a default") from error


def _result(subject: str, made: object, scan: Scan) -> Reconstruction:
    """What a function of somebody's own has given, checked."""
    if not isinstance(made, Reconstruction):
        if not isinstance(made, np.ndarray) or made.shape != scan.grid.shape:
            found = f"an array of shape {made.shape}" if isinstance(made, np.ndarray) else f"a {type(made).__name__}"
            expected = f"a Reconstruction, or a volume of shape {scan.grid.shape}"
            raise InputError(subject, f"{found} as its result", expected)
        made = Reconstruction(made.astype(np.float32), scan.grid)
    if not np.isfinite(made.volume).all():
        raise NumericalError(subject, "a volume with NaN or infinity", "finite numbers")
    return made
