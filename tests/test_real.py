"""The recipes of docs/real.md, on stand-ins of the same form as the data that they are for."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy
import tifffile
from skimage.io import imsave

from phyradgs_cl.api import load_scan

pytestmark = pytest.mark.slow

TEXT = (Path(__file__).resolve().parent.parent / "docs" / "real.md").read_text(encoding="utf-8")
FLAT, DARK = 4000, 100


def walnut() -> None:
    """A PNG of 40 columns by 120 views in which a disc stands beside the axis."""
    folder = Path("gratopy-0.1.0/tests")
    folder.mkdir(parents=True)
    u, at = np.arange(40)[:, None], 20 + 6 * np.sin(np.arange(120) * np.pi / 60)
    imsave(folder / "walnut_sinogram.png", (40000 * (np.abs(u - at) < 5)).astype(np.uint16), check_contrast=False)


def tomobank() -> None:
    """Counts of 32 columns, five rows and 2000 views: air but for the column block 2, behind which a half comes through."""
    folder = Path("bm3d_streak_removal-0.2.0/demo")
    folder.mkdir(parents=True)
    counts = np.full((32, 5, 2000), FLAT, np.uint16)
    counts[16:24] = (FLAT - DARK) // 2 + DARK
    light = {"data_white": np.full((32, 5, 3), FLAT, np.uint16), "data_dark": np.full((32, 5, 3), DARK, np.uint16)}
    scipy.io.savemat(folder / "tomobank_00076_exchange_slices.mat", {"data": counts, **light})


@pytest.mark.parametrize(
    ("heading", "stand_in", "shape"),
    [("## A walnut", walnut, (120, 1, 40)), ("## A sample wider than the panel", tomobank, (250, 1, 4))],
    ids=["walnut", "tomobank"],
)
def test_what_the_packages_hold_is_imported(cli, tmp_path, monkeypatch, heading, stand_in, shape) -> None:
    monkeypatch.chdir(tmp_path)
    stand_in()
    section = TEXT.split(f"{heading}\n")[1].split("\n## ")[0]
    for file, content in re.findall(r"^cat > (\S+) <<'END'\n(.*?\n)END$", section, re.S | re.M):
        Path(file).write_text(content, encoding="utf-8")
        if file.endswith(".py"):
            subprocess.run([sys.executable, file], check=True, timeout=60)
    command = next(line for line in section.replace("\\\n", " ").splitlines() if line.startswith("phyradgs import"))
    words = shlex.split(command, comments=True)[1:]
    assert cli.run(words) == 0
    scan = load_scan(words[words.index("-o") + 1])
    assert scan.projections.shape == shape and scan.grid.shape[0] == 1
    if stand_in is walnut:
        frames = tifffile.imread("walnut/views.tif").reshape(shape)
        np.testing.assert_array_equal(scan.projections, frames)
        assert scan.trajectory.kinematics.angle_start_rad[1] == pytest.approx(np.deg2rad(3))
    else:
        np.testing.assert_allclose(scan.projections[:, 0], np.tile(np.float32([0, 0, np.log(2), 0]), (250, 1)), atol=1e-3)
        assert np.ptp(scan.trajectory.kinematics.angle_start_rad) == pytest.approx(np.pi * 249 / 250)
