"""Checkpoints of interrupted runs: plain arrays in a NumPy archive, never a pickle."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.io.output import beside, written_beside

_FORMAT = 2
_RESTART = "start without --resume"


def checkpoint_path(output: str | Path) -> Path:
    """Returns the path of the checkpoint of a run that writes ``output``."""
    return beside(output, ".checkpoint.npz")


def former_checkpoint_path(output: str | Path) -> Path:
    """Returns the path to which a new run moves the checkpoint of an earlier run of the same output."""
    return beside(output, ".checkpoint.npz.bak")


def partial_path(output: str | Path) -> Path:
    """Returns the path of an interrupted run's result: NAME.partial.SUFFIX for ``output`` NAME.SUFFIX."""
    path = Path(output)
    return beside(path.with_suffix(""), f".partial{path.suffix}")


def write_checkpoint(path: str | Path, state: Mapping[str, np.ndarray]) -> None:
    """Writes the state of a run, complete or not at all."""
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, format=np.array(_FORMAT), **state)  # type: ignore[arg-type]


def read_checkpoint(path: str | Path) -> dict[str, np.ndarray]:
    """Returns the state in a checkpoint. Raises InputError for a missing or damaged file, or another version's."""
    if not Path(path).is_file():
        raise InputError("--resume", f"no checkpoint {path}", "one left by an interrupted run", _RESTART)
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
        if not all(isinstance(values, np.ndarray) for values in arrays.values()):
            raise ValueError("no array")
    except Exception as error:  # zipfile, zlib and NumPy's parser pass on errors of every kind
        reason = f" ({error.strerror})" if isinstance(error, OSError) and error.strerror else ""
        raise InputError(str(path), f"a damaged checkpoint{reason}", "a complete one", _RESTART) from error
    if not np.array_equal(arrays.pop("format", None), _FORMAT):
        raise InputError(str(path), "a checkpoint of another version", f"format {_FORMAT}", _RESTART)
    return arrays
