"""States of interrupted runs: named arrays, with the run's identity and a checksum that are checked before a run resumes."""

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from zlib import crc32

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError

State = Mapping[str, np.ndarray]
"""The named arrays from which an interrupted run resumes. Each method has its own names."""
RUN, _CHECKSUM = "run", "checksum"
"""Names of two arrays in a state: the identity of the run, as JSON, and the checksum of all other arrays."""
_REMEDY = "start without --resume"
_MOST_DIFFERENCES = 3  # an error names at most this many differences between two runs
_LONGEST_NAME = 60  # in an error, the name of each difference is cut to this many characters


def with_identity(state: State, identity: Mapping[str, Any]) -> State:
    """Returns a method's state with a checksum and the identity of its run, as ``RunPlan.identity`` returns it."""
    arrays = {**state, RUN: np.array(json.dumps(identity, default=repr))}
    return {**arrays, _CHECKSUM: np.array(_checksum(arrays))}


def without_identity(
    state: State, identity: Mapping[str, Any], completed: Callable[[dict[str, Any]], dict[str, Any]]
) -> State:
    """Returns the method's state as it was before ``with_identity``. completed: adds to the identity that is stored in
    ``state`` the defaults of newer options. Raises InputError for a damaged state, and for the state of another run."""
    arrays = {name: array for name, array in state.items() if name != _CHECKSUM}
    if not np.array_equal(state.get(_CHECKSUM, -1), _checksum(arrays)):
        raise InputError("checkpoint", "arrays that do not match their checksum", "a whole checkpoint", _REMEDY)
    both = completed(json.loads(str(arrays.pop(RUN)))), identity
    then, now = (json.loads(json.dumps(one, default=repr)) for one in both)  # JSON turns the tuples of both into lists
    differences = list(_differences(then, now))
    if differences:
        more = "; and more" if len(differences) > _MOST_DIFFERENCES else ""
        found = f"a run with other {'; '.join(differences[:_MOST_DIFFERENCES])}{more}"
        raise InputError("--resume", found, "the same run", f"use the same scan and options, or {_REMEDY}")
    return arrays


def _checksum(arrays: State) -> int:
    """Returns the CRC-32 of all arrays with their names, types and shapes, which decide how the bytes are read."""
    total = 0
    for name in sorted(arrays):
        array = arrays[name]
        facts = f"{name} {array.dtype.str} {array.shape}"
        total = crc32(np.ascontiguousarray(array).data, crc32(facts.encode(), total))
    return total


def _differences(then: object, now: object, name: str = "") -> Iterator[str]:
    """Yields "NAME (old value, now new value)" for values that differ between the nested tables ``then`` and ``now``."""
    if isinstance(then, dict) and isinstance(now, dict):
        for key in sorted({*then, *now}):
            yield from _differences(then.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif then != now:
        yield f"{name[:_LONGEST_NAME]} ({checks.short_repr(then)}, now {checks.short_repr(now)})"
