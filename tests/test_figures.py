"""The figure of the conventions shows what projector and TIFF import do; tables of the results are those of their runs."""

import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile

from phyradgs_cl.api import Grid, ray_operator, static_scan
from phyradgs_cl.importers import ImportOptions, import_scan

pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parents[1] / "docs"
SHADOW, IN_FILE = (4, 6), (1, 6)  # as read off docs/images/conventions.png


def brightest(image: np.ndarray) -> tuple[int, ...]:
    return tuple(int(i) for i in np.unravel_index(image.argmax(), image.shape))


def test_the_image_file_has_row_0_on_top(rt, tmp_path) -> None:
    """Of a ball about the point, as wide as a pixel's shadow, projected by rays."""
    drawn = SimpleNamespace(**runpy.run_path(str(DOCS / "conventions.py")))
    geometry, grid = drawn.GEOMETRY, Grid.cube(61, 305.0)
    scan = static_scan(np.zeros((2, *geometry.detector_shape)), geometry, [drawn.ANGLE_DEG, 90.0], grid=grid)
    z, y, x = (5.0 * (np.indices(grid.shape) - 30)).reshape(3, *grid.shape)
    ball = np.linalg.norm(np.stack([x, y, z], -1) - drawn.POINT_MM, axis=-1) < 25
    top_first = ray_operator(scan, "static", device=rt)(ball.astype(np.float32))[0, ::-1]
    assert brightest(top_first) == drawn.pixels()[1] == IN_FILE
    for number in range(2):
        tifffile.imwrite(tmp_path / f"proj_{number}.tif", top_first)
    (tmp_path / "scan.toml").write_text(
        '[frames]\nprojections = "proj_*.tif"\nquantity = "attenuation"\n'
        f"[source]\nto_axis_mm = {geometry.source_to_axis_mm}\nto_detector_mm = {geometry.source_to_detector_mm}\n"
        f"[detector]\npixel_size_v_mm = 50.0\npixel_size_u_mm = 50.0\n"
        f"[angles]\nfirst_deg = {drawn.ANGLE_DEG}\nstep_deg = 180.0\n"
    )
    imported = import_scan(tmp_path, ImportOptions())
    assert brightest(imported.projections[0]) == SHADOW
    assert imported.geometry == geometry


def test_tables_of_the_results_are_those_of_the_recorded_runs() -> None:
    command = [sys.executable, str(DOCS / "make_results.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"run docs/make_results.py: {done.stdout}{done.stderr}"
