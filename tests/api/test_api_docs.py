"""docs/api.md is one program that works, and names everything that the API has."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

from phyradgs_cl import api

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "api.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.S)


def test_the_blocks_of_the_page_run_in_order(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    with_torch = importlib.util.find_spec("torch") is not None
    for block in BLOCKS:
        if with_torch or "import torch" not in block:
            exec(compile(block, "docs/api.md", "exec"), names)
    said = capsys.readouterr().out
    assert "(12, 24, 24)" in said and "PSNR" in said
    assert {path.name for path in tmp_path.iterdir()} == {"scan.h5", "volume.h5"}


def test_the_page_names_everything_and_nothing_else() -> None:
    table = TEXT.split("## A scan")[0]
    missing = [name for name in api.__all__ if f"`{name}" not in table]
    assert not missing
    for name in re.findall(r"from phyradgs_cl\.api import (.*)", TEXT):
        assert set(re.split(r",\s*", name)) <= set(api.__all__)
