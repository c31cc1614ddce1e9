"""Random damage to good files: whatever comes of it, it is a scan or one InputError, soon."""

from __future__ import annotations

import random
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import writers_of_importers as w

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import FORMATS, ImportOptions, import_scan

OPTIONS = {
    "data-exchange": ImportOptions(source_to_axis_mm=500.0, source_to_detector_mm=800.0),
    "phyradgs-real": ImportOptions(pixel_size_mm=(3.0, 2.5)),
}
TRIES, SECONDS = 60, 25.0
TRIES_HDF5 = 12  # each begins with a process of its own
def damaged(path: Path, rng: random.Random) -> None:
    """Some bytes of one file changed, taken out, put in, or everything cut off, mostly near its beginning."""
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    file = rng.choice(files)
    data = bytearray(file.read_bytes())
    for _ in range(rng.choice([1, 1, 2, 4, 8])):
        at = rng.randrange(max(1, min(len(data), 2500) if rng.random() < 0.7 else len(data)))
        kind = rng.random()
        if kind < 0.7:
            data[at : at + 1] = bytes([rng.randrange(256)])
        elif kind < 0.8:
            del data[at : at + rng.randrange(1, 20)]
        elif kind < 0.9:
            data[at:at] = rng.randbytes(rng.randrange(1, 9))
        else:
            del data[at:]
    file.write_bytes(data)


def tries(good: Path, folder: Path, seed: int, count: int) -> Iterator[Path]:
    rng = random.Random(seed)
    for number in range(count):
        path = folder / f"try{number}" / good.name
        path.parent.mkdir()
        (shutil.copytree if good.is_dir() else shutil.copy)(good, path)
        damaged(path, rng)
        yield path


@pytest.mark.filterwarnings("ignore")  # NumPy reads old headers with a warning
@pytest.mark.parametrize("form", FORMATS)
def test_random_damage(tmp_path, make_truth, form) -> None:
    (tmp_path / "good").mkdir()
    good = w.write(form, tmp_path / "good", make_truth)
    refused, count = 0, TRIES_HDF5 if form in ("data-exchange", "nxtomo") else TRIES
    for path in tries(good, tmp_path, seed=len(form), count=count):
        before = time.monotonic()
        try:
            import_scan(path, OPTIONS.get(form), form)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
        assert time.monotonic() - before < SECONDS
    assert refused > count / 10
