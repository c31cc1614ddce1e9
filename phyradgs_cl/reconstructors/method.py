"""Lists the methods by name, and makes methods of users' own functions. To add a method, write a file with a METHOD, which
is a ``Method``, and a line in METHODS.

A method's function takes ``(scan, options, rt, *, seed, report, resume)``; a user's function needs only the first three. If
``options`` is annotated with a dataclass, its fields are the options of ``--set`` and ``reconstruct``. The function returns
a ``Reconstruction``, or a volume (nz, ny, nx) in 1/mm on the scan's grid."""

import importlib
import inspect
import operator
import os
import sys
import time
import typing
from collections import UserDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, PerRow, Scan
from phyradgs_cl.errors import InputError, NumericalError
from phyradgs_cl.reconstructors.result import Reconstruction, function_name, option_facts
from phyradgs_cl.removed import refuse_removed
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.text import suggest_name

_FORM = "a function (scan, options, rt, …)"


@dataclass(frozen=True)
class Method:
    """A reconstruction method: its function, and its presets of options by name, of which the first is the default.

    is_resumable: has checkpoints. is_shared: several ranks (MPI processes) can share its work. takes_initial: can start from
    a volume. takes_deformation: can use a given motion of the object. finds_motion: finds how the object moves or changes.
    check(scan, options): raises InputError for a scan that the method cannot take. It is called before any warning."""

    run: Callable[..., Reconstruction]
    presets: Mapping[str, Any]
    is_resumable: bool = True
    is_shared: bool = False
    takes_initial: bool = False
    takes_deformation: bool = False
    finds_motion: bool = False
    check: Callable[[Scan, Any], object] = lambda scan, options: None


@dataclass(frozen=True)
class OwnOptions:
    """Options of a user's function whose ``options`` argument has no annotation: only the motion model."""

    motion: Motion = PerRow()


def own_method(name: str, function: Any) -> Method:
    """Returns a user's function as the method ``name``. Its default options have the defaults of their class.

    Raises InputError for anything but a function (scan, options, rt, …), and for a class with options without a default."""
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
    """Imports the object ``package.module:name`` and returns it. Modules in the present folder are found too, as by ``python
    -m``. Raises InputError about ``subject`` if the module or the object cannot be imported."""
    module, _, name = text.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        remedy = "start in its folder, or add that to PYTHONPATH"
        raise InputError(subject, f"{text}: {error}", "package.module:function", remedy) from error
    except Exception as error:  # a module may raise anything while it is imported
        found_there = f"{text}: {type(error).__name__}: {error}"
        raise InputError(subject, found_there, "a module that can be imported") from error
    try:
        return operator.attrgetter(name)(found)
    except AttributeError:
        raise InputError(subject, text, f"a function {name} in {module}") from None


def _plain(value: Any) -> Any:
    """Returns ``value`` as JSON can hold it: numbers, texts and None unchanged, mappings value by value, else its repr."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    return value if isinstance(value, int | float | str | None) else repr(value)


def _default_options(subject: str, function: Any, parameter: inspect.Parameter) -> Any:
    try:
        kind = typing.get_type_hints(function).get(parameter.name)
    except (NameError, TypeError):  # annotations may have names that do not exist at run time
        kind = None
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return OwnOptions()
    try:
        return kind()
    except TypeError as error:
        raise InputError(subject, f"{kind.__name__}: {error}", "options that all have a default") from error


def _result(subject: str, made: object, scan: Scan) -> Reconstruction:
    if not isinstance(made, Reconstruction):
        if not isinstance(made, np.ndarray) or made.shape != scan.grid.shape:
            found = f"an array of shape {made.shape}" if isinstance(made, np.ndarray) else f"a {type(made).__name__}"
            expected = f"a Reconstruction, or a volume of shape {scan.grid.shape}"
            raise InputError(subject, f"{found} as its result", expected)
        made = Reconstruction(made.astype(np.float32), scan.grid)
    if not np.isfinite(made.volume).all():
        raise NumericalError(subject, "a volume with NaN or infinity", "finite numbers")
    return made


class _Methods(UserDict[str, Any]):
    """The methods by name. Each method is imported at its first use, because imports take time."""

    def __getitem__(self, name: str) -> Method:
        entry = self.data[name]
        if isinstance(entry, str):
            module, _, attribute = entry.partition(":")
            entry = getattr(import_module(f"phyradgs_cl.reconstructors.{module}"), attribute or "METHOD")
            self.data[name] = entry
        return entry


DEFAULT_METHOD = "fista"
METHODS = _Methods({
    "phyradgs": "splats.method:PHYRADGS",
    "r2": "splats.method:R2",
    "sart": "voxels.sart",
    "os-sart": "voxels.sart:OS_METHOD",
    "sirt": "voxels.sart:SIRT_METHOD",
    "cgls": "voxels.cgls",
    "asd-pocs": "voxels.asd_pocs",
    "fista": "voxels.fista",
    "fista-tv": "voxels.fista_tv",
    "naf": "neural:NAF",
    "sax-nerf": "neural:SAX_NERF",
    "moving": "moving.method",
    "changing": "changing",
    "fdk": "fdk",
    "fbp": "fdk:FBP_METHOD",
})


def method_name(method: object) -> str:
    """Returns the name of a method: a key of METHODS, given in any case, or ``package.module:name`` of the user's own.

    Raises InputError for anything else."""
    if isinstance(method, str) and method.lower() in METHODS:
        return method.lower()
    if callable(method):
        return function_name(method)
    if not isinstance(method, str) or ":" not in method:
        refuse_removed(f"--method {method}".lower())
        expected = f"one of {', '.join(METHODS)}, or package.module:function of your own"
        raise InputError("--method", checks.short_repr(method), expected, suggest_name(method, METHODS, ""))
    return method


def check_able(option: str, method: object, ability: str, kind: str, remedy: str = "choose one of them") -> None:
    """Raises InputError about ``option`` if the method lacks ``ability``, a field of ``Method``, which the option needs.
    kind: what the error calls methods with this ability. remedy: the error's advice."""
    if not getattr(method_of(method), ability):
        names = ", ".join(name for name, one in METHODS.items() if getattr(one, ability))
        raise InputError(option, f"--method {method_name(method)}", f"{kind}: {names}", remedy)


def method_of(method: object) -> Method:
    """Returns the method for a name, or for the user's own function, given as such or as ``package.module:name``.

    Raises InputError for anything else, and for a function that cannot be imported."""
    name = method_name(method)
    if name in METHODS:
        return METHODS[name]
    return own_method(name, imported(name) if isinstance(method, str) else method)
