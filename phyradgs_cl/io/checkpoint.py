"""Checkpoints of interrupted runs: plain arrays in a NumPy archive, never a pickle."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.io.output import beside, written_beside

_FORMAT = 1
_MOST_DIFFERENCES, _LONGEST_NAME = 3, 60
_RESTART = "start without --resume"


def checkpoint_path(output: str | Path) -> Path:
    """Where the checkpoint of a run that writes ``output`` lies."""
    return beside(output, ".checkpoint.npz")


def former_checkpoint_path(output: str | Path) -> Path:
    """Where the checkpoint of an earlier run is kept that another run of the same output has found."""
    return beside(output, ".checkpoint.npz.bak")


def partial_path(output: str | Path) -> Path:
    """Where an interrupted run that was to write ``output`` leaves what it has: NAME.partial.SUFFIX."""
    path = Path(output)
    return beside(path.with_suffix(""), f".partial{path.suffix}")


def write_checkpoint(path: str | Path, arrays: dict[str, np.ndarray], fingerprint: str) -> None:
    """Writes arrays whole or not at all; ``fingerprint`` says as JSON which scan and options they are of."""
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, format=np.array(_FORMAT), fingerprint=np.array(fingerprint), **arrays)  # type: ignore[arg-type]


def read_checkpoint(path: str | Path, fingerprint: str) -> dict[str, np.ndarray]:
    """The arrays of a checkpoint. Raises InputError if it is missing, damaged or of another scan or options."""
    if not Path(path).is_file():
        raise InputError("--resume", f"no checkpoint {path}", "one left by an interrupted run", _RESTART)
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
        if not all(isinstance(values, np.ndarray) for values in arrays.values()):
            raise ValueError("no array")
    except Exception as error:  # zipfile, zlib and NumPy's parser hand on whatever they stumble over
        reason = f" ({error.strerror})" if isinstance(error, OSError) and error.strerror else ""
        raise InputError(str(path), f"a damaged checkpoint{reason}", "a whole one", _RESTART) from error
    if not np.array_equal(arrays.pop("format", None), _FORMAT):
        raise InputError(str(path), "another checkpoint format", str(_FORMAT), _RESTART)
    found = str(arrays.pop("fingerprint", ""))
    if found != fingerprint:
        remedy = f"use the same scan and options, or {_RESTART}"
        expected = "one of this run"
        raise InputError(str(path), f"a checkpoint of {_other_run(found, fingerprint)}", expected, remedy)
    return arrays


def _other_run(found: str, wanted: str) -> str:
    unknown = "another scan or other options"
    try:
        then, now = json.loads(found), json.loads(wanted)
    except (ValueError, RecursionError):  # of an earlier version, or damaged
        return unknown
    differences = list(_differences(then, now)) if isinstance(then, dict) else []
    told = differences[:_MOST_DIFFERENCES]
    more = "; and more" if len(differences) > len(told) else ""
    return f"a run with other {'; '.join(told)}{more}" if told else unknown


def _differences(found: object, wanted: object, name: str = "") -> Iterator[str]:
    """NAME (then, now) of every value that is not the same in two trees of tables."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        for key in sorted({*found, *wanted}):
            yield from _differences(found.get(key), wanted.get(key), f"{name}.{key}" if name else key)
    elif found != wanted:
        yield f"{name[:_LONGEST_NAME]} ({checks.shown(found)}, now {checks.shown(wanted)})"
