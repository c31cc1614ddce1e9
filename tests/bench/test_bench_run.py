"""Whole benchmarks at sizes of some voxels, and the numbers of their tables against values that are known."""

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erfc
from tables import KINDS, RESULTS, BenchJob, BenchSize, plan_runs, remake_tables, rows_of, run_bench, sizes
from tables.__main__ import run
from tables.case import FLY, STILL
from tables.metrics import Bead, roundness
from tables.metrics.edge import RISE_PER_SIGMA, bead_edge, blurred_ball
from tables.metrics.roundness import bead_sections
from tables.published import TABLE1, TABLE2
from tables.results import read_lines

from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.runtime import Runtime

pytestmark = pytest.mark.slow
TINY = BenchSize("T", 12, 16, 8)
ROWS = ["FDK", "PhyRadGS w/o ST", "PhyRadGS"]


@pytest.fixture(scope="module")
def whole(rt: Runtime, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two volumes of some voxels, and in out/ a benchmark of them."""
    folder = tmp_path_factory.mktemp("whole")
    z, y, x = np.mgrid[-1:1:24j, -1:1:24j, -1:1:24j]
    ball, box = x**2 + y**2 + z**2 < 0.4, (np.abs(x) < 0.5) & (np.abs(y) < 0.4)
    for name, inside in (("ball_24", ball), ("box", box)):
        with h5py.File(folder / f"{name}.h5", "w") as file:
            file["volume"] = (200 * inside * (np.abs(z) < 0.7)).astype(np.uint8)
    job = BenchJob("table1", folder / "out", folder, TINY, protocols=["rapid"], rows=ROWS)
    assert all(path.stat().st_size for path in run_bench(job, lambda: rt))
    return folder


@pytest.fixture
def made(whole: Path, tmp_path: Path) -> BenchJob:
    """A benchmark whose runs are all there."""
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    return BenchJob("table1", tmp_path / "out", tmp_path, TINY, protocols=["rapid"], rows=ROWS)


def test_lines_and_tables_have_what_the_page_needs(made: BenchJob, rt: Runtime) -> None:
    job = replace(made, seeds=(0, 1))
    run_bench(job, lambda: rt)
    lines = read_lines(job.output / RESULTS)
    line = next(x for x in lines if (x["label"], x["volume"]) == ("PhyRadGS", "ball"))
    expected = {"source": "ball_24.h5", "acquisition": FLY, "method": "phyradgs", "views": 25, "iterations": 8}
    assert line | expected == line and line["options"]["motion"]["name"] == "micro-views"
    assert {"psnr_db", "ssim", "psnr_2d_db", "ssim_2d", "data_range"} <= line["metrics"].keys()
    ours = [x for x in lines if x["label"] == "PhyRadGS"]
    per_seed = [np.mean([x["metrics"]["psnr_db"] for x in ours if x["seed"] == seed]) for seed in (0, 1)]
    text = (job.output / "table1_T.md").read_text()
    (row,) = [row for row in text.splitlines() if row.startswith("| PhyRadGS |") and row.endswith("| 31.23 / 0.871 |")]
    assert f"| {np.mean(per_seed):.2f} ± {np.std(per_seed, ddof=1):.2f} |" in row
    with open(job.output / "table1_T.csv", newline="") as file:
        records = list(csv.DictReader(file))
    assert [(r["row"], r["acquisition"]) for r in records] == [
        ("FDK", FLY), ("FDK", STILL), ("PhyRadGS w/o ST", FLY), ("PhyRadGS w/o ST", STILL), ("PhyRadGS", FLY),
    ]  # fmt: skip
    assert float(records[-1]["psnr_db"]) == pytest.approx(np.mean(per_seed))
    tables = {path: path.read_text() for path in job.output.glob("table1_T.*") if path.suffix in (".md", ".csv")}
    remake_tables(job)
    assert {path: path.read_text() for path in tables} == tables


def test_rows_are_the_papers_and_a_plan_runs_over_seeds_volumes_and_protocols(tmp_path: Path) -> None:
    labels = {kind: [row.label for row in rows_of(kind)] for kind in KINDS}
    assert set(TABLE1) <= set(labels["table1"]) and set(TABLE2) <= set(labels["table2"])
    rows = ["PhyRadGS", "PhyRadGS w/o ST", "R2-Gaussian w/ ST"]
    job = BenchJob("table1", tmp_path, rows=rows, names=["foot"], protocols=["rapid"], iterations=7)
    planned = [(run.acquisition, run.row.label) for run in plan_runs(job)]
    still = [("stop-and-shoot", label) for label in ("PhyRadGS w/o ST", "R2-Gaussian")]
    assert sorted(planned) == sorted([*(("fly-scan", label) for label in rows), *still])
    cases = [run.case for run in plan_runs(BenchJob("table1", tmp_path, rows=["FDK"], seeds=(0, 1)))]
    assert len(cases) == 2 * len(set(cases)) == 2 * 8
    for wrong in ({"rows": ["PhyRad"]}, {"protocols": ["static"]}, {"seeds": ()}, {"size": "XXL"}, {"names": ["hand"]}):
        with pytest.raises(InputError):
            plan_runs(BenchJob("table1", tmp_path, **wrong))  # type: ignore[arg-type]


def test_the_sphere_phantom_study_runs_and_says_shape(tmp_path: Path, rt: Runtime) -> None:
    job = BenchJob("phantom", tmp_path / "out", size=BenchSize("T", 40, 32, 8), rows=["FDK", "PhyRadGS"])
    run_bench(job, lambda: rt)
    lines = {(x["label"], x["acquisition"]): x["metrics"] for x in read_lines(job.output / RESULTS)}
    references = {("truth", "reference"), ("pseudo-truth", "reference")}
    assert set(lines) == references | {("FDK", FLY), ("PhyRadGS", FLY), ("FDK", STILL), ("PhyRadGS w/o ST", STILL)}
    scores = {"psnr_db", "psnr_db_pseudo", "psnr_2d_db", "roundness", "edge_rise_mm"}
    assert lines["PhyRadGS", FLY].keys() >= scores
    assert "| pseudo-truth |" in (job.output / "phantom_T.md").read_text()


def test_the_command_runs_resumes_and_makes_tables(made: BenchJob, capsys, monkeypatch) -> None:
    monkeypatch.setitem(sizes.SIZES, "XS", replace(TINY, name="XS"))
    shutil.rmtree(made.output)
    command = ["table1", "--volumes", str(made.volumes), "-o", str(made.output), "--size", "XS", "--protocols", "rapid"]
    assert run([*command, "--rows", "FDK"]) == 0
    first = capsys.readouterr().out
    assert "FDK (fly-scan): PSNR" in first
    assert run([*command, "--rows", "FDK", "--table-only"]) == 0
    written = [line for line in first.splitlines() if line.startswith(str(made.output))]
    assert capsys.readouterr().out.splitlines() == written
    assert run([*command, "--rows", "PhyRadSG"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("phyradgs: --rows") and error.count("\n") == 1


GRID = Grid.cube(64, 32.0)  # half a millimetre per voxel
CENTRE = (0.3, -0.2, 0.4)


def drawn(axes_mm: tuple[float, float, float], sigma_mm: float = 0.0) -> np.ndarray:
    """An ellipsoid of density 1 on a background of 0.2, blurred."""
    volume = EllipsoidPhantom((Ellipsoid(CENTRE, axes_mm, 1.0),), "bead").voxelise(GRID, 4) + 0.2
    return gaussian_filter(volume, sigma_mm / 0.5) if sigma_mm else volume


def test_the_rise_of_a_known_blur_is_found() -> None:
    for radius_mm, sigma_mm in ((3.0, 0.0), (3.0, 0.5), (6.0, 1.5)):
        edge = bead_edge(drawn((radius_mm,) * 3, sigma_mm), GRID, Bead(CENTRE, radius_mm))
        # 5 %: a voxel's box is not a Gaussian
        assert edge.rise_mm == pytest.approx(RISE_PER_SIGMA * float(np.hypot(sigma_mm, 0.5 / np.sqrt(12))), rel=0.05)
        assert edge.radius_mm == pytest.approx(radius_mm, abs=0.02)
    distance = np.linspace(97.0, 103.0, 13)
    straight = 0.5 * erfc((distance - 100) / np.sqrt(2))  # a large ball is a straight edge
    np.testing.assert_allclose(blurred_ball(distance, 100.0, 1.0), straight, atol=5e-3)


def test_round_beads_are_round_and_an_ellipsoid_is_out_of_round_by_its_axes() -> None:
    score = roundness(drawn((6.0,) * 3, 0.7), GRID, [Bead(CENTRE, 6.0)])
    assert score["roundness"] < 0.01 and score["centre_shift_mm"] < 0.02 and score["round_sections"] == 3
    sections = bead_sections(drawn((6.6, 6.0, 6.0)), GRID, Bead(CENTRE, 6.0))
    for name in ("axial", "coronal"):
        assert sections[name].span == pytest.approx(0.6 / 6.3, abs=0.02)
        # radii of an ellipse run between the axes as a cosine: RMS is the amplitude over √2
        assert sections[name].rms == pytest.approx(0.3 / 6.3 / np.sqrt(2), abs=0.006)
    assert np.isnan(roundness(np.zeros(GRID.shape), GRID, [Bead(CENTRE, 6.0)])["roundness"])
