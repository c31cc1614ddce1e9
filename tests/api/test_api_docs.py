"""docs/api.md is one program that works, and names everything that the API has."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl import api

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "api.md").read_text(encoding="utf-8")
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
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
    (block,) = re.findall(r"```python\n(.*?)```", (EXAMPLES.parent / "README.md").read_text(encoding="utf-8"), re.S)
    counts = np.round(200 + 40_000 * np.exp(-scan.projections)).astype(np.uint16)
    flats, darks = (np.full((2, *counts.shape[1:]), level, np.uint16) for level in (40_200, 200))
    names = {"frames": counts, "angles_deg": 60.0 * np.arange(6), "flats": flats, "darks": darks}
    exec(compile(block.replace("2000", "20"), "README.md", "exec"), names)
    assert names["result"].gaussians.count > 0 and names["scan"].projections.shape == counts.shape


def test_the_page_names_everything_and_nothing_else() -> None:
    table = TEXT.split("## A scan")[0]
    missing = [name for name in api.__all__ if f"`{name}" not in table]
    assert not missing
    for name in re.findall(r"from phyradgs_cl\.api import (.*)", TEXT):
        assert set(re.split(r",\s*", name)) <= set(api.__all__)


def lines_by_job(code: str) -> list[int]:
    """Lines of code of a program's parts, each of which begins with a comment."""
    parts = re.split(r"^# .*\n", code, flags=re.M)[1:]
    return [len(part.split("\n")) - 1 for part in parts]


def test_ours_is_no_longer_than_any_of_theirs() -> None:
    beside = TEXT.split("## Beside")[1].split("## Limits")[0]
    ours = "".join(code for code in re.findall(r"```python\n(.*?)```", beside, re.S) if code.startswith("# "))
    programs = [ours, *re.findall(r"```py\n(.*?)```", beside, re.S)]
    assert max(len(line) for line in ours.splitlines()) <= 110
    counts = [lines_by_job(code) for code in programs]
    assert [len(count) for count in counts] == [6, 6, 6, 5], "CIL has no bridge to PyTorch"
    counts[3].append(0)
    rows = re.findall(r"^\| ([^|]*) \| (\S+) \| (\S+) \| (\S+) \| (\S+) \|$", beside, re.M)[1:]
    assert len(rows) == 7 and rows[-1][0] == "together"
    for (job, *cells), found in zip(rows, [*zip(*counts, strict=True), tuple(map(sum, counts))], strict=True):
        assert tuple(0 if cell == "none" else int(cell) for cell in cells) == found, job
        assert found[0] <= min(count for count in found[1:] if count), job


def function(text: str, name: str) -> str:
    """The source of a function in a text."""
    found = re.search(rf"^def {name}\(.*?(?=^\S)", text, re.S | re.M)
    assert found, name
    return found[0].strip()


@pytest.mark.parametrize(("example", "name"), [("own_sirt", "sirt"), ("train_own", "train")])
def test_an_example_stands_in_the_page_as_it_is_in_its_file(example, name) -> None:
    source = (EXAMPLES / f"{example}.py").read_text(encoding="utf-8")
    assert function(TEXT, name) == function(source, name)
