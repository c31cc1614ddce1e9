"""docs/api.md is one program that works, and names everything that the API has."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl import api

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.S)


def test_the_blocks_of_the_page_run_in_order(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    with_torch = importlib.util.find_spec("torch") is not None
    for block in BLOCKS:
        if with_torch or not re.search(r"import torch|as_torch\(", block):
            exec(compile(block, "docs/api.md", "exec"), names)
    said = capsys.readouterr().out
    assert "(12, 24, 24)" in said and "PSNR" in said
    assert {path.name for path in tmp_path.iterdir()} == {"scan.h5", "volume.h5", "partial.h5"}


def test_the_readme_s_lines_run_on_raw_counts(scan) -> None:
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)
    counts = np.round(200 + 40_000 * np.exp(-scan.projections)).astype(np.uint16)
    flats, darks = (np.full((2, *counts.shape[1:]), level, np.uint16) for level in (40_200, 200))
    names = {"frames": counts, "angles_deg": 60.0 * np.arange(6), "flats": flats, "darks": darks}
    exec(compile(block.replace("2000", "20"), "README.md", "exec"), names)
    assert names["result"].gaussians.count > 0 and names["scan"].projections.shape == counts.shape


def test_the_page_names_everything_and_nothing_else() -> None:
    table = TEXT.split("## A scan")[0]
    assert not [name for name in api.__all__ if f"`{name}" not in table]
    for name in re.findall(r"from phyradgs_cl\.api import (.*)", TEXT):
        assert set(re.split(r",\s*", name)) <= set(api.__all__)
