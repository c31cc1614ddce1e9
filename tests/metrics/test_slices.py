"""The figure of slices: a PNG comes out, and unwritable places are named."""

from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.errors import OutputError
from phyradgs_cl.metrics import slices_png


def test_the_picture_has_three_columns_also_of_nothing_and_a_missing_folder_is_named(tmp_path: Path) -> None:
    volume, nothing = np.random.default_rng(0).uniform(size=(6, 8, 10)).astype(np.float32), np.zeros((3, 3, 3))
    for result, truth, least in ((volume + 0.1, volume, 600), (nothing, nothing, 1)):
        slices_png(tmp_path / "a.png", result, truth, "title")
        head = (tmp_path / "a.png").read_bytes()[:24]
        assert head.startswith(b"\x89PNG\r\n\x1a\n")
        assert int.from_bytes(head[16:20], "big") >= least and int.from_bytes(head[20:24], "big") > 0
    with pytest.raises(OutputError, match="missing"):
        slices_png(tmp_path / "missing" / "a.png", nothing, nothing, "title")
