"""What a command imports before it answers: seconds that nobody has to wait for."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume

HEAVY = {"matplotlib", "pyopencl", "scipy.fft", "scipy.ndimage", "scipy.spatial", "scipy.special", "skimage", "torch"}
REGISTRY = {"phyradgs_cl.reconstructors.method"}
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
        ("nonsense", 2, {"h5py"}), ("reconstruct --help", 0, set()), ("info v.h5", 0, REGISTRY),
        ("export v.h5 --to npy", 0, REGISTRY),
    ],  # fmt: skip
)
def test_nothing_is_loaded_that_the_answer_does_not_need(tmp_path: Path, words, status, never) -> None:
    grid = Grid.cube(4, 2.0)
    write_volume(tmp_path / "v.h5", np.ones(grid.shape, np.float32), grid, {})
    command = [sys.executable, "-c", PROGRAM, "modules.txt", *words.split()]
    assert subprocess.run(command, cwd=tmp_path, capture_output=True, check=False).returncode == status
    modules = set((tmp_path / "modules.txt").read_text().split())
    assert "phyradgs_cl.signals" in modules and not modules & (HEAVY | never)
