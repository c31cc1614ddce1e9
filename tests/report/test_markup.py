"""Elements, pictures and words that a page is made of."""

import json

import numpy as np
import pytest

from phyradgs_cl.fields import Grid
from phyradgs_cl.report.images import BUDGET_PIXELS, planes_of, windows_of
from phyradgs_cl.report.markup import json_block, label, number, raw_text, shown, unit

pytestmark = pytest.mark.slow


def test_data_cannot_end_their_block() -> None:
    text = json_block("data", {"a": "</script><!--&"})
    assert text.count("<") == 2
    assert json.loads(text[text.index(">") + 1 : text.rindex("<")]) == {"a": "</script><!--&"}
    with pytest.raises(ValueError):
        raw_text("script", "'</SCRIPT>'")


def test_facts_have_words_and_units() -> None:
    assert (label("psnr_db"), unit("psnr_db")) == ("PSNR", "dB")
    assert (label("unit_density_per_mm"), unit("unit_density_per_mm")) == ("unit density", "1/mm")
    assert [number(v) for v in (0.012345, -2.0, 1e-7, float("inf"))] == ["0.01235", "−2", "1·10⁻⁷", "∞"]
    # what rounding left of zero is zero, where a resolution is known
    assert number(-3.495e-15, 0.1) == "0" and number(-3.495e-15) == "−3.495·10⁻¹⁵"
    assert shown(-3.495e-15, "mm") == "0\N{NARROW NO-BREAK SPACE}mm" and shown([1e-14, 0.25], "°") == "0, 0.25°"


def test_large_volumes_are_thinned_out_and_small_ones_are_whole() -> None:
    volume = np.zeros((300, 4, 500), np.float32)
    volume[:, :, :] = np.linspace(0, 1, 500, dtype=np.float32)
    grid = Grid(volume.shape, (1.0, 2.0, 1.0))
    planes = {plane.axis: plane for plane in planes_of(volume, None, grid, windows_of(volume, None))}
    assert planes["y"].indices == [0, 1, 2, 3] and planes["y"].size_mm == (500.0, 300.0)
    kept = planes["x"].indices
    assert kept[0] == 0 and kept[-1] == 499 and len(kept) < 500 and np.ptp(np.diff(kept)) <= 1
    assert planes["x"].first_mm == -249.5
    edges = {"x": (192, 4), "y": (192, 192), "z": (4, 192)}
    assert sum(len(planes[a].indices) * np.prod(edges[a]) for a in "xyz") <= BUDGET_PIXELS
