"""The methods by name, and those of one's own. Adding one is a file that says its METHOD, and a line in METHODS."""

import math
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Exact, Motion, Scan
from phyradgs_cl.acquisition.motion import MODELS, STILL, check_own_motion
from phyradgs_cl.errors import InputError, OutOfMemoryError, naming_host_memory
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics import resampled
from phyradgs_cl.prepare import TOLD
from phyradgs_cl.prepare.masked import with_masked
from phyradgs_cl.reconstructors.holdout import held_out, holdout_errors
from phyradgs_cl.reconstructors.method import Method, imported, own_method
from phyradgs_cl.reconstructors.preprocess import InputOptions, prepared
from phyradgs_cl.reconstructors.result import (
    HELD_OUT,
    MARGIN_MM,
    ProgressReport,
    Reconstruction,
    function_name,
    ignore_progress,
)
from phyradgs_cl.reconstructors.tune.trials import tuned
from phyradgs_cl.reconstructors.tune.wish import check_wish
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.text import near_miss

_COUNTS = tuple(dict.fromkeys(f.name for model in MODELS for f in fields(model) if f.init))
"""The fields of motion models, by which options name them."""
_ALL = (*STILL, Exact())  # of methods of one's own


class _Methods(MutableMapping[str, Method]):
    """Methods by name, each imported when it is asked for: what it needs takes time."""

    def __init__(self, places: Mapping[str, str]) -> None:
        self._found: dict[str, str | Method] = dict(places)

    def __getitem__(self, name: str) -> Method:
        found = self._found[name]
        if isinstance(found, str):
            module, _, attribute = found.partition(":")
            found = getattr(import_module(f"phyradgs_cl.reconstructors.{module}"), attribute or "METHOD")
            self._found[name] = found
        return found

    def __setitem__(self, name: str, method: Method) -> None:
        self._found[name] = method

    def __delitem__(self, name: str) -> None:
        del self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)


DEFAULT_METHOD = "fista"
METHODS = _Methods({
    "phyradgs": "splats.phyradgs",
    "r2": "splats.r2",
    "sart": "voxels.sart",
    "os-sart": "voxels.sart:OS_METHOD",
    "sirt": "voxels.sirt",
    "cgls": "voxels.cgls",
    "asd-pocs": "voxels.asd_pocs",
    "fista": "voxels.fista",
    "fista-tv": "voxels.fista_tv",
    "naf": "neural.naf",
    "sax-nerf": "neural.sax_nerf",
    "fused": "fused",
    "fdk": "fdk",
})


def method_name(method: object) -> str:
    """The name of a method: a key of METHODS, however its letters are cased, or ``package.module:name`` of one's own.

    Raises InputError for what is none.
    """
    if isinstance(method, str) and method.lower() in METHODS:
        return method.lower()
    if callable(method):
        return function_name(method)
    if not isinstance(method, str) or ":" not in method:
        expected = f"one of {', '.join(METHODS)}, or package.module:function of your own"
        raise InputError("--method", checks.shown(method), expected, near_miss(method, METHODS, ""))
    return method


def method_of(method: object) -> Method:
    """The method of that name; a function of one's own, itself or by ``package.module:name``, as a method.

    Raises InputError for what is none, or cannot be imported.
    """
    name = method_name(method)
    if name in METHODS:
        return METHODS[name]
    return own_method(name, imported(name) if isinstance(method, str) else method)


def usual_preset(method: object) -> str:
    """The name of the preset that a method has by itself."""
    return next(iter(method_of(method).presets))


def method_options(
    method: object, preset: str | None = None, changes: Mapping[str, Any] | None = None, tune: str = ""
) -> Any:
    """The options of a method: a preset, with ``changes`` by field name (nested ones as tables) applied.

    ``motion``, ``strips``, ``sub_intervals``, ``segments`` and ``time_error`` change the motion model together; ``motion``
    may be a model of one's own. ``tune``: which option the scan will choose.
    Raises InputError for a name that the method does not have, so that no option is accepted and ignored.
    """
    name, presets = method_name(method), method_of(method).presets
    chosen = next(iter(presets)) if preset is None else preset
    if not isinstance(chosen, str) or chosen not in presets:
        having = [other for other, one in METHODS.items() if isinstance(chosen, str) and chosen in one.presets]
        remedy = f"--method {' or '.join(having)} has it" if having else ""
        raise InputError("--preset", checks.shown(chosen), f"one of {', '.join(presets)} for --method {name}", remedy)
    changes = dict(changes or {})
    base = presets[chosen]
    if hasattr(base, "motion"):
        motion = changes.pop("motion", None)
        counts = {key: value for key in _COUNTS if (value := changes.pop(key, None)) is not None}
        base = replace(base, motion=_motion(name, base, motion, counts))
    options = _changed(base, changes, f"--method {name}")
    if tune:
        check_wish(tune, name, options, changes, method_of(method).ends_anywhere)
    return options


def reconstruct(
    scan: Scan,
    method: object,
    rt: Runtime,
    options: Any = None,
    *,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    before: InputOptions | None = None,
    initial: tuple[np.ndarray, Grid] | None = None,
    **extra: Any,
) -> Reconstruction:
    """Runs a method, by its name or a function of one's own; ``options`` as from ``method_options``, its default when None.

    ``before`` says what is done to the frames first; None undoes the scan's lag and filters nothing. ``initial``: a volume
    in 1/mm and its grid, from which a method starts that can; it is resampled onto the scan's.
    """
    asked = InputOptions() if before is None else before
    chosen = method_options(method, tune=asked.tune) if options is None else options
    if rt.ranks.size > 1:
        _check_ranks(method_name(method), rt)
    if asked.margin_mm is not None:
        _check_margin(method, chosen)
    ready = prepared(scan, asked, rt)
    ready.check_sight()
    check_own_motion(getattr(chosen, "motion", None), ready)
    if initial is not None:
        extra["initial"] = _initial(method, *initial, ready.grid)
    held = held_out(ready, asked.holdout) if asked.holdout else None
    seen = ready if held is None else with_masked(ready, held)
    run = partial(method_of(method).run, rt=rt, seed=seed)
    with _naming_margin(asked, ready.grid), naming_host_memory():
        if asked.tune:
            result = tuned(asked.tune, run, seen, chosen, rt, report, **extra)
        else:
            result = run(seen, chosen, report=report, **extra)
    if held is not None and rt.ranks.rank == 0:
        result.facts[HELD_OUT] = holdout_errors(rt, ready, held, result)
    if TOLD in ready.provenance:
        result.facts[TOLD] = ready.provenance[TOLD]
    if asked.margin_mm is None:
        return result
    result.facts[MARGIN_MM] = asked.margin_mm
    return result.within(asked.of(scan.grid))


def _initial(method: object, volume: np.ndarray, grid: Grid, onto: Grid) -> np.ndarray:
    """A first volume on the grid of the scan; InputError for a method that starts from none."""
    if not method_of(method).takes_initial:
        taking = ", ".join(name for name, one in METHODS.items() if one.takes_initial)
        raise InputError("--initial", f"--method {method_name(method)}", f"one of {taking}", "leave --initial out")
    if grid == onto:
        return volume
    first, share = resampled(volume, grid, onto)
    if share == 0:
        box_mm = np.round(grid.box_mm, 3).tolist()
        raise InputError("--initial", f"a volume in {box_mm} mm (z, y, x)", "one that meets the scan's grid")
    return first


def _check_margin(method: object, options: Any) -> None:
    """InputError where a method would do nothing with voxels beyond the box."""
    if (way := getattr(options, "extrapolate", None)) not in (None, "reprojected"):
        found = f"--method {method_name(method)} with extrapolate={way}, whose voxels do not depend on each other"
        remedy = "add --set extrapolate=reprojected, or leave it out"
        raise InputError("--margin-mm", found, "a method that explains frames by what is in the box", remedy)


@contextmanager
def _naming_margin(asked: InputOptions, grid: Grid) -> Iterator[None]:
    """Where memory does not do, the body's error says what the margin has made of the grid."""
    try:
        yield
    except OutOfMemoryError as error:
        if asked.margin_mm is not None:
            voxels = " × ".join(map(str, grid.shape[::-1]))
            error.remedy += f", as by a narrower --margin-mm (with it the grid has {voxels} voxels)"
        raise


def _check_ranks(method: str, rt: Runtime) -> None:
    """InputError where the method has no work for several ranks, or ranks would not come to the same numbers."""
    if method not in METHODS or not METHODS[method].is_shared:
        sharing = ", ".join(name for name, one in METHODS.items() if one.is_shared)
        found = f"{rt.ranks.size} ranks"
        raise InputError(f"--method {method}", found, f"one, or one of {sharing}", "start it without mpiexec")
    device, first = rt.device.name, rt.ranks.bcast(rt.device.name)
    if device != first:
        culprit = f"device of rank {rt.ranks.rank}"
        raise InputError(
            culprit, device, f"that of rank 0, {first}", "choose devices of one kind with --device"
        )


def input_options(changes: Mapping[str, Any]) -> InputOptions:
    """Input options by name, checked as the methods' own are."""
    return _changed(InputOptions(), changes, "reconstruct")


def input_names(method: object, preset: str | None = None) -> list[str]:
    """The names of the input options, but those that the method's own options have too, which go before them."""
    own = {f.name for f in fields(method_options(method, preset))}
    return [f.name for f in fields(InputOptions) if f.name not in own]


def motions_of(method: object) -> tuple[str, ...]:
    """The names of the motion models that a method takes."""
    return tuple(_models(next(iter(method_of(method).presets.values()))))


def _models(options: Any) -> dict[str, Any]:
    """The models of ``options`` by name, with what the preset says of its own."""
    own = [options.motion] if hasattr(options.motion, "name") else []
    return {model.name: model for model in (*getattr(options, "MOTIONS", _ALL), *own)}


def _has(model: Any, count: str) -> bool:
    return any(f.name == count and f.init for f in fields(model))


def _motion(method: str, options: Any, motion: Any, counts: dict[str, Any]) -> Motion:
    """The model of ``options`` by its name, with the counts that are given, of which it must have each; or one's own."""
    if callable(getattr(motion, "cells", None)) and not counts:
        return motion
    models = _models(options)
    if motion is None and not hasattr(options.motion, "name"):
        return options.motion
    name = _implied_motion(options.motion.name, counts, models) if motion is None else motion
    if not isinstance(name, str) or name not in models:
        raise InputError("--motion", checks.shown(name), f"one of {', '.join(models)} for --method {method}")
    model = models[name]
    for key, value in counts.items():
        option = "--" + key.replace("_", "-")
        if not _has(model, key):
            having = " or ".join(n for n, other in models.items() if _has(other, key))
            found = f"--motion {name} for --method {method}"
            expected = f"--motion {having}" if having else "a method with a motion that has them"
            raise InputError(option, found, expected, f"leave {option} out")
        model = replace(model, **{key: _converted(getattr(model, key), value, option)})
    return model


def _implied_motion(usual: str, counts: Mapping[str, Any], models: Mapping[str, Any]) -> str:
    """The usual model; where that follows the motion in its own way, the one that has what is given.

    A method that is static by itself stays so until it is told otherwise.
    """
    if usual.startswith("static") or all(_has(models[usual], key) for key in counts):
        return usual
    having = [name for name, model in models.items() if all(_has(model, key) for key in counts)]
    return having[0] if len(having) == 1 else usual


def _motion_options(options: Any) -> list[str]:
    """The names by which the motion of ``options`` can be changed."""
    if not hasattr(options, "motion"):
        return []
    return ["motion", *(key for key in _COUNTS if any(_has(m, key) for m in _models(options).values()))]


def _changed(options: Any, changes: Mapping[str, Any], culprit: str) -> Any:
    """``options`` with ``changes`` by name; ``culprit`` is the method, or the table that they belong to."""
    known = {f.name: getattr(options, f.name) for f in fields(options) if f.name != "motion"}
    values: dict[str, Any] = {}
    for key, value in changes.items():
        if key not in known:
            names = [*known, *_motion_options(options)]
            remedy = near_miss(key, names, _having(key) or "leave it out")
            raise InputError(f"{culprit}: option {key}", "no such option", ", ".join(names), remedy)
        is_function = callable(value) and key in getattr(options, "FUNCTIONS", ())
        values[key] = value if is_function else _converted(known[key], value, f"{culprit}: option {key}")
    try:
        return replace(options, **values)
    except (TypeError, ValueError) as error:  # of options of one's own, which check in their own way
        raise InputError(culprit, str(error), "values that its options take") from error


def _having(option: str) -> str:
    """The methods that have an option, as advice; nothing where none has."""
    usual = {name: next(iter(one.presets.values())) for name, one in METHODS.items()}
    having = [name for name, options in usual.items() if hasattr(options, option)]
    return f"--method {' or '.join(having)} has it" if having else ""


def _converted(current: Any, value: Any, culprit: str) -> Any:
    """``value`` as the type of the present value: numbers, words, tuples, nested tables; where there is none, as it is."""
    if current is None:  # the options check it themselves
        return value.item() if isinstance(value, np.generic) else value
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if is_dataclass(current):
        if not isinstance(value, Mapping):
            raise InputError(culprit, checks.shown(value), "a table")
        return _changed(current, value, culprit)
    if isinstance(current, tuple):
        if not isinstance(value, (list, tuple)) or len(value) != len(current):
            raise InputError(culprit, checks.shown(value), f"a list of {len(current)} numbers")
        return tuple(_converted(c, v, culprit) for c, v in zip(current, value, strict=True))
    if type(current) not in _EXPECTED:  # of options of one's own
        return value
    expected, fits = _EXPECTED[type(current)]
    if not fits(value):
        raise InputError(culprit, checks.shown(value), expected)
    return type(current)(value)


def _is_number(value: Any) -> bool:
    """Whether ``value`` is a finite number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # whole numbers have no bounds
        return False


_EXPECTED: dict[type, tuple[str, Callable[[Any], bool]]] = {
    bool: ("true or false", lambda value: isinstance(value, bool)),
    str: ("a word", lambda value: isinstance(value, str)),
    int: ("a whole number", lambda value: _is_number(value) and value == int(value)),
    float: ("a finite number", _is_number),
}
