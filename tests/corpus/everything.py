"""All cases, in one order."""

from collections.abc import Iterator
from pathlib import Path

from corpus import checkpoints, hdf5_files, imports, text_files
from corpus.case import Case


def all_cases(good: Path, seed: int = 0) -> Iterator[Case]:
    """Every case that the good files in ``good`` give."""
    yield from hdf5_files.cases(good, seed)
    yield from text_files.cases(seed)
    yield from checkpoints.cases(good)
    yield from imports.cases()
