"""Checkpoints of interrupted runs: plain arrays in a NumPy archive, never a pickle."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.atomic import written_beside
from phyradgs_cl.io.npz import read_npz

_FORMAT = 1
_RESTART = "start without --resume"


def checkpoint_path(output: str | Path) -> Path:
    """Where the checkpoint of a run that writes ``output`` lies."""
    return Path(f"{output}.checkpoint.npz")


def write_checkpoint(path: str | Path, arrays: dict[str, np.ndarray], fingerprint: str) -> None:
    """Writes arrays whole or not at all; ``fingerprint`` says which scan and options they belong to."""
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, format=np.array(_FORMAT), fingerprint=np.array(fingerprint), **arrays)


def read_checkpoint(path: str | Path, fingerprint: str) -> dict[str, np.ndarray]:
    """The arrays of a checkpoint. Raises InputError if it is missing, damaged or of another scan or options."""
    if not Path(path).is_file():
        raise InputError("--resume", f"no checkpoint {path}", "one left by an interrupted run", _RESTART)
    arrays = read_npz(path, "checkpoint", _RESTART)  # nothing is compressed: together no larger than the file
    if not np.array_equal(arrays.pop("format", None), _FORMAT):
        raise InputError(str(path), "another checkpoint format", str(_FORMAT), _RESTART)
    if str(arrays.pop("fingerprint", "")) != fingerprint:
        remedy = f"use the same scan and options, or {_RESTART}"
        raise InputError(
            str(path), "a checkpoint of another scan or other options", "one of this run", remedy
        )
    return arrays
