"""Checks of states from files, before a run resumes from them."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError

State = Mapping[str, np.ndarray]
"""The state of an interrupted run as named arrays, from which it resumes. Each method has its own names."""
RUN = "run"
"""The array of a state that holds the identity of its run, as JSON."""
_REMEDY = "start without --resume"
_MOST_DIFFERENCES, _LONGEST_NAME = 3, 60
T = TypeVar("T")


def with_identity(state: State, identity: Mapping[str, Any]) -> State:
    """Returns a method's state with the identity of its run, as from ``RunPlan.identity``."""
    return {**state, RUN: np.array(json.dumps(identity, default=repr))}


def without_identity(state: State, identity: Mapping[str, Any]) -> State:
    """Returns the method's own state; raises InputError for the state of another run."""
    then, now = parsed(state, RUN, dict), json.loads(json.dumps(identity, default=repr))  # in JSON tuples are lists
    differences = list(_differences(then, now))
    if differences:
        more = "; and more" if len(differences) > _MOST_DIFFERENCES else ""
        found = f"a run with other {'; '.join(differences[:_MOST_DIFFERENCES])}{more}"
        raise InputError("--resume", found, "the same run", f"use the same scan and options, or {_REMEDY}")
    return {name: array for name, array in state.items() if name != RUN}


def _differences(then: object, now: object, name: str = "") -> Iterator[str]:
    """Yields NAME (then, now) for every value that differs in two trees of tables."""
    if isinstance(then, dict) and isinstance(now, dict):
        for key in sorted({*then, *now}):
            yield from _differences(then.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif then != now:
        yield f"{name[:_LONGEST_NAME]} ({checks.short_repr(then)}, now {checks.short_repr(now)})"


def state_arrays(state: State, names: Sequence[str]) -> list[np.ndarray]:
    """Returns arrays of a state by name; raises InputError for a state that lacks one."""
    missing = sorted(set(names) - set(state))
    if missing:
        raise InputError("checkpoint", f"no {', '.join(missing)}", "a whole checkpoint", _REMEDY)
    return [state[name] for name in names]


def history_arrays(record: Sequence[Mapping[str, float]], seconds: float) -> dict[str, np.ndarray]:
    """Returns a convergence record and the seconds so far as arrays of a state."""
    return {"record": np.array(json.dumps(list(record))), "seconds": np.array(seconds)}


def check_like(state: State, like: Mapping[str, np.ndarray]) -> None:
    """Raises InputError unless ``state`` has every array of ``like``, with its shape and type, and finite."""
    for name, found in zip(like, state_arrays(state, list(like)), strict=True):
        check_array(name, found, np.asarray(like[name]).shape, np.asarray(like[name]).dtype)


def check_cloud(state: State, frames: int) -> None:
    """Raises InputError unless raw (11, G), moments (2, 11, G), statistics (2, G) and queue (``frames``) fit."""
    raw, moments, statistics, queue = state_arrays(state, ("raw", "moments", "statistics", "queue"))
    gaussians = raw.shape[-1] if raw.ndim else 0
    check_array("raw", raw, (11, max(gaussians, 1)), np.float32)
    check_array("moments", moments, (2, 11, gaussians), np.float32)
    check_array("statistics", statistics, (2, gaussians), np.float32)
    check_array("queue", queue, (min(queue.size, frames),), np.int64)
    if queue.size and not 0 <= queue.min() <= queue.max() < frames:
        raise _damaged("queue", f"{queue.min()} to {queue.max()}", f"frames from 0 to {frames - 1}")


def check_array(name: str, found: np.ndarray, shape: tuple[int, ...], dtype: np.typing.DTypeLike) -> None:
    """Raises InputError unless an array has this shape and type, and is finite; texts may have any length."""
    wanted = np.dtype(dtype)
    same = found.dtype.kind == "U" if wanted.kind == "U" else found.dtype == wanted
    if found.shape != shape or not same:
        raise _damaged(name, f"shape {found.shape} of {found.dtype}", f"shape {shape} of {wanted}")
    if wanted.kind == "f" and not np.isfinite(found).all():
        raise _damaged(name, "NaN or infinity", "finite numbers")


def count_of(state: State, name: str, most: int) -> int:
    """Returns a whole number of a state; raises InputError unless it is from 0 to ``most``."""
    (found,) = state_arrays(state, [name])
    check_array(name, found, (), np.int64)
    if not 0 <= int(found) <= most:
        raise _damaged(name, str(int(found)), f"a whole number from 0 to {most}")
    return int(found)


def parsed(state: State, name: str, kind: type[T]) -> T:
    """Returns the content of a state's JSON text; raises InputError unless its type is ``kind``."""
    (found,) = state_arrays(state, [name])
    check_array(name, found, (), np.str_)
    try:
        content = json.loads(str(found))
    except (ValueError, RecursionError) as error:
        raise _damaged(name, "text that is not JSON", "the text of a run") from error
    if not isinstance(content, kind):
        raise _damaged(name, f"JSON {type(content).__name__}", f"JSON {kind.__name__}")
    return content


def checked_history(state: State) -> tuple[list[dict[str, float]], float]:
    """Returns the convergence record and the seconds of a state; a line of the record has the numbers of an iteration."""
    lines = parsed(state, "record", list)
    (seconds,) = state_arrays(state, ["seconds"])
    check_array("seconds", seconds, (), np.float64)
    for line in lines:
        if not isinstance(line, dict) or not all(isinstance(v, (int, float)) for v in line.values()):
            raise _damaged("record", "a line that is no table of numbers", "the text of a run")
    return lines, float(seconds)


def restore_generator(rng: np.random.Generator, state: State) -> None:
    """Restores the state of a random generator."""
    content = parsed(state, "rng", dict)
    try:
        rng.bit_generator.state = content
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise _damaged("rng", "no state of a random generator", "the text of a run") from error


def _damaged(name: str, found: str, expected: str) -> InputError:
    return InputError(f"checkpoint, array {name}", found, expected, _REMEDY)
