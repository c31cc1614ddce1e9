"""Figures show what the package does: conventions, by projector, shutter and TIFF import; what check and calibrate mend."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import tifffile

from phyradgs_cl.api import Grid, ray_operator, static_scan
from phyradgs_cl.importers import ImportOptions, import_scan

pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parents[1] / "docs"
SHADOW, IN_FILE = (4, 6), (1, 6)  # as read off docs/images/conventions.png


def module_of_the_docs(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"{name}_of_the_docs", DOCS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def drawn() -> ModuleType:
    return module_of_the_docs("conventions")


@pytest.fixture(scope="module")
def frame(drawn, rt) -> np.ndarray:
    """The projection (rows, columns) of a ball about the point, as wide as a pixel's shadow, by the ray-driven projector."""
    geometry = drawn.GEOMETRY
    grid = Grid.cube(61, 305.0)
    scan = static_scan(np.zeros((2, *geometry.detector_shape)), geometry, [drawn.ANGLE_DEG, 90.0], grid=grid)
    z, y, x = (5.0 * (np.indices(grid.shape) - 30)).reshape(3, *grid.shape)
    to_point_mm = np.stack([x, y, z], -1) - drawn.POINT_MM
    ball = np.linalg.norm(to_point_mm, axis=-1) < 25
    return ray_operator(scan, "static", device=rt)(ball.astype(np.float32))[0]


def brightest(image: np.ndarray) -> tuple[int, ...]:
    return tuple(int(i) for i in np.unravel_index(image.argmax(), image.shape))


def test_the_image_file_has_row_0_on_top(drawn, frame, tmp_path) -> None:
    geometry, top_first = drawn.GEOMETRY, frame[::-1]
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


@pytest.mark.parametrize("name", ["check", "calibrate"])
def test_the_picture_after_is_better_than_the_one_before(name) -> None:
    """At a third of the size that the documentation shows."""
    figure = getattr(module_of_the_docs("examples_drawn"), f"{name}_figure")(size=16)
    scores = re.findall(r": (\S+) dB", " ".join(axes.get_title() for axes in figure.axes))
    before_db, after_db = map(float, scores)
    assert after_db > before_db + 2


def test_tables_of_the_results_are_those_of_the_recorded_runs() -> None:
    command = [sys.executable, str(DOCS / "make_results.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"run docs/make_results.py: {done.stdout}{done.stderr}"
