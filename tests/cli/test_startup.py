"""What a command imports before it answers: seconds that nobody has to wait for. Times: benchmarks/startup.py."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume

HEAVY = {"matplotlib", "pyopencl", "scipy.fft", "scipy.ndimage", "scipy.spatial", "scipy.special", "skimage", "torch"}
PROGRAM = """
import sys
from phyradgs_cl.__main__ import load_cli
status = load_cli().run(sys.argv[2:])
open(sys.argv[1], "w").write(" ".join(sys.modules))
sys.exit(status)
"""


@pytest.mark.parametrize(
    ("words", "status", "never"),
    [
        (["--help"], 0, {"h5py"}),
        (["nonsense"], 2, {"h5py"}),
        (["reconstruct", "--help"], 0, set()),
        (["reconstruct", "--nonsense"], 2, set()),
        (["simulate", "--size", "many"], 2, set()),
        (["info", "{volume}"], 0, {"phyradgs_cl.reconstructors.registry"}),
        (["export", "{volume}", "--to", "npy"], 0, {"phyradgs_cl.reconstructors.registry"}),
    ],
    ids=lambda value: " ".join(value[:2]) if isinstance(value, list) else "",
)
def test_nothing_is_loaded_that_the_answer_does_not_need(tmp_path: Path, words, status, never) -> None:
    grid = Grid.cube(4, 2.0)
    write_volume(tmp_path / "v.h5", np.ones(grid.shape, np.float32), grid, {})
    words = [word.format(volume=tmp_path / "v.h5") for word in words]
    list_of_modules = tmp_path / "modules.txt"
    command = [sys.executable, "-c", PROGRAM, str(list_of_modules), *words]
    assert subprocess.run(command, capture_output=True, check=False).returncode == status
    modules = set(list_of_modules.read_text().split())
    assert "phyradgs_cl.signals" in modules
    assert not modules & (HEAVY | never)
