"""Volumes of runs that did not come to their end: everybody who opens one says so, once."""

import json
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.fields import Grid
from phyradgs_cl.io import partial_path, write_volume

pytestmark = pytest.mark.slow
SAID = "interrupted at iteration 812 of 3000"
READERS = {
    "evaluate": ["evaluate", "{volume}", "--reference", "{volume}", "--json"], "info": ["info", "{volume}", "--json"],
    "report": ["report", "{volume}", "-o", "{folder}/page.html"], "export": ["export", "{volume}", "--to", "npy"],
    "simulate": ["simulate", "--volume", "{volume}", "--detector", "8", "--views", "2", "-o", "{folder}/scan.h5"],
}  # fmt: skip


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    grid = Grid.cube(6, 2.0)
    history = {"method": "sirt", "interrupted_at": 812, "options": {"iterations": 3000}}
    write_volume(tmp_path / "v.h5", np.linspace(0, 1, 216, dtype=np.float32).reshape(grid.shape), grid, history)
    return tmp_path / "v.h5"


@pytest.mark.parametrize("name", READERS)
def test_a_reader_says_where_the_run_was_interrupted(cli, stored, caplog, capsys, name) -> None:
    words = [word.format(volume=stored, folder=stored.parent) for word in READERS[name]]
    assert cli.run(words) == 0
    assert caplog.text.count(SAID) == 1 and f"{stored}: {SAID}" in caplog.text
    if "--json" in words:
        facts = json.loads(capsys.readouterr().out)
        assert (facts["interrupted_at"], facts["iterations_asked"]) == (812, 3000)


def test_a_partial_volume_has_a_name_of_its_own_where_no_scan_lies(refused, tmp_path) -> None:
    for name in ("v.partial.h5", "volume", ".hidden", "a.b.h5"):
        path = partial_path(tmp_path / name)
        assert path.parent == tmp_path and path.name != name and ".partial" in path.name
        assert path.suffix in ("", Path(name).suffix) or not Path(name).suffix
    scan = tmp_path / "volume.partial.h5"
    scan.write_bytes(b"a scan")
    refused(["reconstruct", scan, "-o", tmp_path / "volume.h5", "--method", "fdk"], "reads or writes")
    assert list(tmp_path.iterdir()) == [scan]
