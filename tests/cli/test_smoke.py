"""Every command once, each on what the ones before it have made, and what a command imports before it answers."""

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import typer

from phyradgs_cl.fields import Grid
from phyradgs_cl.io import read_volume, write_volume
from phyradgs_cl.workflow import load_scan

SCAN = "--phantom jaw --size 10 --detector 12 --views 4 --time-samples 2"
CONE = "--source-to-axis-mm 500 --source-to-detector-mm 800 --pixel-size-mm 3,3"
GRID = 'scans = ["scan.h5"]\n[[runs]]\nmethod = "fdk"\n'
# (command line, what it leaves)
COMMANDS = (
    ("devices", ""), (f"simulate {SCAN} -o scan.h5", "scan.h5"), ("info scan.h5", ""), ("check scan.h5", ""),
    (f"simulate {SCAN} --views 8 -o eight.h5", "eight.h5"),
    (f"simulate {SCAN} --turns 2 --motion-of-object breathing.toml -o moving.h5", "moving.h5"),
    ("calibrate eight.h5 --what offset -o calibrated.h5", "calibrated.png"),
    ("prepare scan.h5 -o clean.h5", "clean.h5"), ("estimate scan.h5 --method sirt", ""),
    ("reconstruct scan.h5 --iterations 2 -o volume.h5", "volume.h5"),
    ("evaluate volume.h5 --reference scan.h5 --json", "volume.evaluated.png"),
    ("report volume.h5 --scan scan.h5 --views 2 -o page.html", "page.html"), ("view volume.h5", ""),
    ("export volume.h5 --to nrrd -o volume.nrrd", "volume.nrrd"),
    (f"import foreign.h5 --format data-exchange {CONE} -o imported.h5", "imported.h5"),
    ("sweep grid.toml -o swept", "swept/results.md"),
)  # fmt: skip


def write_foreign(path: Path) -> None:
    """Counts of four frames, a flat and a dark, as a synchrotron would store them."""
    with h5py.File(path, "w") as file:
        file["exchange/data"] = np.linspace(400, 900, 4 * 8 * 9).reshape(4, 8, 9).astype(np.uint16)
        for name, counts in (("white", 1000), ("dark", 0)):
            file[f"exchange/data_{name}"] = np.full((1, 8, 9), counts, np.uint16)
        file["exchange/theta"] = np.arange(4) * 90.0


def test_every_command_does_its_work(cli, tmp_path, monkeypatch, capsys) -> None:
    windows = []
    assert {line.split()[0] for line, _ in COMMANDS} == set(typer.main.get_command(cli.app).commands)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("phyradgs_cl.commands.report.view_volume", windows.append)
    write_foreign(tmp_path / "foreign.h5")
    (tmp_path / "grid.toml").write_text(GRID)
    (tmp_path / "breathing.toml").write_text('kind = "breathing"')
    for line, output in COMMANDS:
        assert cli.run(line.split()) == 0, f"{line}: {capsys.readouterr().err}"
        assert (tmp_path / output).exists(), line
    assert len(windows) == 1 and load_scan(tmp_path / "imported.h5").frames == 4
    assert read_volume(tmp_path / "volume.h5").values.any()


HEAVY = {"matplotlib", "pyopencl", "scipy.fft", "scipy.ndimage", "scipy.spatial", "scipy.special", "skimage", "torch"}
REGISTRY = {"phyradgs_cl.reconstructors.method"}
IMPORTS = """
import sys
from phyradgs_cl.__main__ import load_cli
status = load_cli().run(sys.argv[2:])
open(sys.argv[1], "w").write(" ".join(sys.modules))
sys.exit(status)
"""


@pytest.mark.parametrize(("words", "status", "never"), [
    ("nonsense", 2, {"h5py"}), ("reconstruct --help", 0, set()), ("export v.h5 --to npy", 0, REGISTRY),
])  # fmt: skip
def test_nothing_is_loaded_that_the_answer_does_not_need(tmp_path: Path, words, status, never) -> None:
    grid = Grid.cube(4, 2.0)
    write_volume(tmp_path / "v.h5", np.ones(grid.shape, np.float32), grid, {})
    command = [sys.executable, "-c", IMPORTS, "modules.txt", *words.split()]
    assert subprocess.run(command, cwd=tmp_path, capture_output=True, check=False).returncode == status
    modules = set((tmp_path / "modules.txt").read_text().split())
    assert "phyradgs_cl.signals" in modules and not modules & (HEAVY | never)
