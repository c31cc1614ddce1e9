"""Options of a method and of the preprocessing by name: a preset with checked changes."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion
from phyradgs_cl.acquisition.motion import MODELS, RAYS, SPLATS, Centres, motions_for
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.method import METHODS, method_name, method_of
from phyradgs_cl.reconstructors.preprocess import Preprocessing
from phyradgs_cl.removed import refuse_removed
from phyradgs_cl.text import suggest_name

_COUNTS = tuple(dict.fromkeys(f.name for model in MODELS for f in fields(model) if f.init))
"""The fields of motion models, by which options name them."""
_ALL = motions_for(RAYS, SPLATS)  # for the user's own methods


def method_options(method: object, preset: str | None = None, changes: Mapping[str, Any] | None = None) -> Any:
    """Returns the options of a method: a preset with ``changes`` by field name, nested ones as tables.

    ``motion``, ``strips``, ``sub_intervals``, ``segments`` and ``time_error`` change the motion model together; ``motion``
    may be the user's own model. Raises InputError for a name that the method lacks, so that no option is ignored."""
    name, presets = method_name(method), method_of(method).presets
    chosen = next(iter(presets)) if preset is None else preset
    if not isinstance(chosen, str) or chosen not in presets:
        refuse_removed(f"--preset {chosen}")
        having = [other for other, one in METHODS.items() if isinstance(chosen, str) and chosen in one.presets]
        remedy = f"--method {' or '.join(having)} has it" if having else ""
        raise InputError("--preset", checks.short_repr(chosen), f"one of {', '.join(presets)} for --method {name}", remedy)
    changes = dict(changes or {})
    base = presets[chosen]
    if hasattr(base, "motion"):
        motion = changes.pop("motion", None)
        counts = {key: value for key in _COUNTS if (value := changes.pop(key, None)) is not None}
        base = replace(base, motion=_motion(name, base, motion, counts))
    return _changed(base, changes, f"--method {name}")


def preprocessing_of(changes: Mapping[str, Any]) -> Preprocessing:
    """Returns the checked preprocessing with ``changes`` by name."""
    return _changed(Preprocessing(), changes, "reconstruct")


def preprocessing_names(method: object, preset: str | None = None) -> list[str]:
    """Returns the names of preprocessing options, except names that the method's own options have too."""
    own = {f.name for f in fields(method_options(method, preset))}
    return [f.name for f in fields(Preprocessing) if f.name not in own]


def _models(options: Any) -> dict[str, Any]:
    """Returns the models of ``options`` by name; the preset's own model has the preset's counts."""
    own = [options.motion] if hasattr(options.motion, "name") else []
    return {model.name: model for model in (*getattr(options, "MOTIONS", _ALL), *own)}


def _has(model: Any, count: str) -> bool:
    return any(f.name == count and f.init for f in fields(model))


def _motion(method: str, options: Any, motion: Any, counts: dict[str, Any]) -> Motion:
    """Returns the motion model of that name with the given counts, each of which it must have, or the user's own model."""
    if callable(getattr(motion, "cells", None)) and not counts:
        return motion
    models = _models(options)
    if motion is None and not hasattr(options.motion, "name"):
        return options.motion
    name = _implied_motion(options.motion.name, counts, models) if motion is None else motion
    if not isinstance(name, str) or name not in models:
        raise InputError("--motion", checks.short_repr(name), f"one of {', '.join(models)} for --method {method}")
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
    """Returns the name of the usual model, or of the only model with the given counts; ``centres`` is chosen by name only.

    A method whose usual model is static stays static unless ``motion`` is given."""
    if usual.startswith("static") or all(_has(models[usual], key) for key in counts):
        return usual
    having = [name for name, m in models.items() if name != Centres.name and all(_has(m, key) for key in counts)]
    return having[0] if len(having) == 1 else usual


def _motion_options(options: Any) -> list[str]:
    if not hasattr(options, "motion"):
        return []
    return ["motion", *(key for key in _COUNTS if any(_has(m, key) for m in _models(options).values()))]


def _changed(options: Any, changes: Mapping[str, Any], subject: str) -> Any:
    """Returns ``options`` with ``changes`` by name; ``subject`` is the method, or the table of the options."""
    known = {f.name: getattr(options, f.name) for f in fields(options) if f.name != "motion"}
    values: dict[str, Any] = {}
    for key, value in changes.items():
        if key not in known:
            place = f"{subject}: option {key}"
            refuse_removed(place.split(": option ", 1)[1].replace(": option ", "."), place)
            refuse_removed(place)
            names = [*known, *_motion_options(options)]
            remedy = suggest_name(key, names, _having(key) or "leave it out")
            raise InputError(place, "no such option", ", ".join(names), remedy)
        is_function = callable(value) and key in getattr(options, "FUNCTIONS", ())
        values[key] = value if is_function else _converted(known[key], value, f"{subject}: option {key}")
    try:
        return replace(options, **values)
    except (TypeError, ValueError) as error:  # the user's own options have their own checks
        raise InputError(subject, str(error), "values that its options take") from error


def _having(option: str) -> str:
    """Returns the advice to use a method that has the option, or nothing."""
    usual = {name: next(iter(one.presets.values())) for name, one in METHODS.items()}
    having = [name for name, options in usual.items() if hasattr(options, option)]
    return f"--method {' or '.join(having)} has it" if having else ""


def _converted(current: Any, value: Any, subject: str) -> Any:
    """Returns ``value`` as the type of the present value: number, word, tuple or nested table; unchanged if that is None."""
    if current is None:  # the options check it themselves
        return value.item() if isinstance(value, np.generic) else value
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if is_dataclass(current):
        if not isinstance(value, Mapping):
            raise InputError(subject, checks.short_repr(value), "a table")
        return _changed(current, value, subject)
    if isinstance(current, tuple):
        if not isinstance(value, (list, tuple)) or len(value) != len(current):
            raise InputError(subject, checks.short_repr(value), f"a list of {len(current)} numbers")
        return tuple(_converted(c, v, subject) for c, v in zip(current, value, strict=True))
    if type(current) not in _EXPECTED:  # of the user's own options
        return value
    expected, fits = _EXPECTED[type(current)]
    if not fits(value):
        raise InputError(subject, checks.short_repr(value), expected)
    return type(current)(value)


def _is_number(value: Any) -> bool:
    """True for a finite number that a float can hold."""
    return checks.is_number(value) and abs(value) <= sys.float_info.max


_EXPECTED: dict[type, tuple[str, Callable[[Any], bool]]] = {
    bool: ("true or false", lambda value: isinstance(value, bool)),
    str: ("a word", lambda value: isinstance(value, str)),
    int: ("a whole number", lambda value: _is_number(value) and value == int(value)),
    float: ("a finite number", _is_number),
}
