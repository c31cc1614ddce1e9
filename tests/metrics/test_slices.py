"""The figure of slices: a PNG comes out, and unwritable places are named."""

from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.errors import OutputError
from phyradgs_cl.metrics import slices_png

PNG = b"\x89PNG\r\n\x1a\n"


def _size(path: Path) -> tuple[int, int]:
    head = path.read_bytes()[:24]
    assert head.startswith(PNG)
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")


def test_the_picture_has_three_columns_also_of_nothing(tmp_path: Path) -> None:
    volume = np.random.default_rng(0).uniform(size=(6, 8, 10)).astype(np.float32)
    slices_png(tmp_path / "with.png", volume + 0.1, volume, "title")
    assert _size(tmp_path / "with.png")[0] > 600
    slices_png(tmp_path / "empty.png", np.zeros((3, 3, 3)), np.zeros((3, 3, 3)), "nothing")
    assert min(_size(tmp_path / "empty.png")) > 0


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="missing"):
        slices_png(tmp_path / "missing" / "a.png", np.ones((3, 3, 3)), np.ones((3, 3, 3)), "title")
