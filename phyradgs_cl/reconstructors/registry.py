"""The methods by name. Adding one is a file beside this one and a line in METHODS."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from typing import Any

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.fdk import FdkOptions, fdk
from phyradgs_cl.reconstructors.phyradgs import phyradgs
from phyradgs_cl.reconstructors.r2 import r2
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, ignore_progress
from phyradgs_cl.reconstructors.splat_options import PRESETS, R2_PUBLISHED
from phyradgs_cl.runtime import Runtime


@dataclass(frozen=True)
class Method:
    """A reconstruction method: how to run it, its option presets (the first is the default), can it be resumed."""

    run: Callable[..., Reconstruction]
    presets: Mapping[str, Any]
    is_resumable: bool = True


METHODS = {
    "phyradgs": Method(phyradgs, PRESETS),
    "r2": Method(r2, {"published": R2_PUBLISHED}),
    "fdk": Method(fdk, {"ram-lak": FdkOptions()}, is_resumable=False),
}


def method_options(method: str, preset: str | None = None, changes: Mapping[str, Any] | None = None) -> Any:
    """The options of a method: a preset, with ``changes`` by field name (nested ones as tables) applied.

    ``motion``, ``strips`` and ``sub_intervals`` change the motion model together. Raises InputError for a name
    that the method does not have, so that no option is accepted and ignored.
    """
    if method not in METHODS:
        raise InputError("--method", repr(method), f"one of {', '.join(METHODS)}")
    presets = METHODS[method].presets
    name = preset or next(iter(presets))
    if name not in presets:
        raise InputError("--preset", repr(name), f"one of {', '.join(presets)} for --method {method}")
    changes = dict(changes or {})
    base = presets[name]
    motion = _motion(
        method, base.motion, {k: changes.pop(k, None) for k in ("motion", "strips", "sub_intervals")}
    )
    return _changed(replace(base, motion=motion), changes, f"--method {method}")


def reconstruct(
    scan: Scan,
    method: str,
    rt: Runtime,
    options: Any = None,
    *,
    seed: int = 0,
    report: ProgressReport = ignore_progress,
    **extra: Any,
) -> Reconstruction:
    """Runs a method by name; ``options`` as from ``method_options``, the method's default when None."""
    chosen = method_options(method) if options is None else options
    return METHODS[method].run(scan, chosen, rt, seed=seed, report=report, **extra)


def _motion(method: str, base: Motion, given: dict[str, Any]) -> Motion:
    name = given["motion"] or base.name
    counts = {k: v for k, v in given.items() if k != "motion" and v is not None}
    if counts and name != "micro-views":
        option = "--" + next(iter(counts)).replace("_", "-")
        raise InputError(
            option, f"--motion {name} for --method {method}", "--motion micro-views, which alone has strips"
        )
    return replace(base, name=name, **counts)


def _changed(options: Any, changes: Mapping[str, Any], culprit: str) -> Any:
    known = {f.name: getattr(options, f.name) for f in fields(options) if f.name != "motion"}
    values: dict[str, Any] = {}
    for key, value in changes.items():
        if key not in known:
            close = get_close_matches(key, known, n=1)
            remedy = f"did you mean {close[0]!r}?" if close else "leave it out"
            raise InputError(f"{culprit}: option {key}", "no such option", ", ".join(known) or "none", remedy)
        values[key] = _converted(known[key], value, f"{culprit}: option {key}")
    return replace(options, **values)


def _converted(current: Any, value: Any, culprit: str) -> Any:
    """``value`` as the type of the present value: numbers, pairs, nested tables."""
    if is_dataclass(current):
        if not isinstance(value, Mapping):
            raise InputError(culprit, repr(value), "a table")
        return _changed(current, value, culprit)
    if isinstance(current, tuple):
        if not isinstance(value, (list, tuple)) or len(value) != len(current):
            raise InputError(culprit, repr(value), f"a list of {len(current)} numbers")
        return tuple(_converted(c, v, culprit) for c, v in zip(current, value, strict=True))
    if isinstance(current, bool):
        if not isinstance(value, bool):
            raise InputError(culprit, repr(value), "true or false")
        return value
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if isinstance(current, int) and not (is_number and value == int(value)):
        raise InputError(culprit, repr(value), "a whole number")
    if isinstance(current, float) and not is_number:
        raise InputError(culprit, repr(value), "a number")
    return type(current)(value)
