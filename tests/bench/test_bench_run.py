"""Whole benchmarks at sizes of some voxels: resuming, tables, figures, poses, interruptions, the phantom study."""

import csv
import json
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from tables import RESULTS, BenchJob, BenchProgress, BenchSize, remake_tables, result_text, run_bench, sizes
from tables import rows as bench_rows
from tables import run as bench_run
from tables.__main__ import run
from tables.case import FLY, STILL, HeldOutViews, SyntheticCase, held_out, stop_and_shoot
from tables.phantom_case import BEADS, HOLDER, PhantomCase, beads_of, c_arm, phantom_in
from tables.raw_counts import Panel, measured_attenuation
from tables.results import read_lines

from phyradgs_cl.acquisition import PROTOCOLS, ConeGeometry, Static
from phyradgs_cl.errors import InputError, NumericalError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import only_run
from phyradgs_cl.io.lock import BusyError
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.signals import stop_on_interrupt
from phyradgs_cl.simulation import phantom_scene

TINY = BenchSize("T", 12, 16, 8)
ROWS = ["FDK", "PhyRadGS w/o ST", "PhyRadGS"]
RUNS = 2 * 5  # of either volume three on the fly-scan, two on the stop-and-shoot scan


def no_runtime() -> Runtime:
    raise AssertionError("a device was asked for")


@pytest.fixture(scope="module")
def whole(rt: Runtime, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two volumes of some voxels, and in out/ a benchmark of them."""
    folder = tmp_path_factory.mktemp("whole")
    z, y, x = np.mgrid[-1:1:24j, -1:1:24j, -1:1:24j]
    ball, box = x**2 + y**2 + z**2 < 0.4, (np.abs(x) < 0.5) & (np.abs(y) < 0.4)
    for name, inside in (("ball_24", ball), ("box", box)):
        with h5py.File(folder / f"{name}.h5", "w") as file:
            file["volume"] = (200 * inside * (np.abs(z) < 0.7)).astype(np.uint8)
    seen: list[BenchProgress] = []
    made = BenchJob("table1", folder / "out", folder, TINY, protocols=["rapid"], rows=ROWS)
    written = run_bench(made, lambda: rt, seen.append)
    assert [p.number for p in seen if p.line is not None] == list(range(1, RUNS + 1))
    assert all(path.stat().st_size for path in written)
    return folder


@pytest.fixture
def made(whole: Path, tmp_path: Path) -> BenchJob:
    """A benchmark whose runs are all there."""
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    return BenchJob("table1", tmp_path / "out", tmp_path, TINY, protocols=["rapid"], rows=ROWS)


@pytest.fixture
def job(made: BenchJob) -> BenchJob:
    """One of which no run is there."""
    shutil.rmtree(made.output)
    return made


@pytest.fixture
def fdk(job: BenchJob) -> BenchJob:
    return replace(job, rows=["FDK"], names=["ball"])


def lines_of(job: BenchJob) -> list[dict]:
    return read_lines(job.output / RESULTS)


def test_a_run_is_not_made_twice_and_a_damaged_line_again(made: BenchJob, rt: Runtime) -> None:
    results = made.output / RESULTS
    whole = results.read_bytes()
    assert whole.count(b"\n") == RUNS
    run_bench(made, no_runtime)
    assert results.read_bytes() == whole
    results.write_bytes(whole[:-40])  # killed while the last line was written
    seen: list[BenchProgress] = []
    run_bench(made, lambda: rt, seen.append)
    assert [p.number for p in seen if p.line is not None] == [RUNS] and len(lines_of(made)) == RUNS
    run_bench(made, no_runtime)
    with only_run(results), pytest.raises(BusyError, match="another run"):
        run_bench(made, no_runtime)


def test_lines_have_what_is_needed_to_make_them_again(made: BenchJob, rt: Runtime) -> None:
    line = next(x for x in lines_of(made) if (x["label"], x["volume"]) == ("PhyRadGS", "ball"))
    expected = {
        "source": "ball_24.h5", "acquisition": "fly-scan", "method": "phyradgs", "seed": 0, "axis": "rows",
        "run": "phyradgs micro-views 8x5", "voxels": 12, "pixels": 16, "views": 25, "protocol": "rapid",
        "iterations": 8, "numpy": np.__version__, "device": rt.device.name,
    }  # fmt: skip
    assert line | expected == line and line["python"]
    motion = line["options"]["motion"]
    assert (motion["name"], motion["strips"], motion["sub_intervals"]) == ("micro-views", 8, 5)
    assert {"psnr_db", "ssim", "psnr_2d_db", "ssim_2d", "data_range"} <= line["metrics"].keys()


def test_tables_have_means_papers_numbers_and_rows_without_pytorch(
    made: BenchJob, rt: Runtime, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(bench_rows, "has_torch", lambda: False)
    with pytest.raises(InputError, match=r"--rows: found NAF \(needs PyTorch\); expected .*pip install"):
        run_bench(replace(made, rows=["NAF"]), no_runtime)
    job = replace(made, rows=[*ROWS, "NAF"], seeds=(0, 1))
    run_bench(job, lambda: rt)
    assert "left out: NAF needs PyTorch" in caplog.text
    lines = lines_of(job)
    text = (job.output / "table1_T.md").read_text()
    means, _, rest = text.partition("Each method with a model of the motion")
    rows = {row.split("|")[1].strip(): row for row in means.splitlines() if row.startswith("|")}
    per_seed = [
        np.mean([x["metrics"]["psnr_db"] for x in lines if x["label"] == "PhyRadGS" and x["seed"] == seed])
        for seed in (0, 1)
    ]
    assert f"| {np.mean(per_seed):.2f} ± {np.std(per_seed, ddof=1):.2f} |" in rows["PhyRadGS"]
    assert rows["PhyRadGS"].endswith("| 31.23 / 0.871 |")
    assert "NAF (needs PyTorch)" in rows and "ball" in rest
    gains = rest[: rest.index("PSNR (dB) / SSIM")]  # the volumes one by one follow
    assert [row.split("|")[1].strip() for row in gains.splitlines() if row.startswith("| P")] == ["PhyRadGS"]
    with open(job.output / "table1_T.csv", newline="") as file:
        records = list(csv.DictReader(file))
    assert [(r["row"], r["acquisition"]) for r in records] == [
        ("FDK", FLY), ("FDK", STILL), ("PhyRadGS w/o ST", FLY), ("PhyRadGS w/o ST", STILL), ("PhyRadGS", FLY),
    ]  # fmt: skip
    full = records[-1]
    assert float(full["psnr_db"]) == pytest.approx(np.mean(per_seed))
    assert (full["volumes"], full["seeds"], full["paper_psnr_db"]) == ("2", "2", "31.23")
    assert f"{float(records[3]['psnr_db']):.2f} ± " in rows["PhyRadGS"]  # the bound stands beside the row


def test_every_volume_is_looked_at_before_the_first_run(job: BenchJob) -> None:
    with h5py.File(job.volumes / "zero.h5", "w") as file:
        file["volume"] = np.zeros((24, 24, 24), np.float32)
    with pytest.raises(InputError, match=r"zero.h5: found values from 0 to 0"):
        run_bench(job, no_runtime)
    with h5py.File(job.volumes / "zero.h5", "r+") as file:
        file["volume"][3, 4, 5] = np.nan
    with pytest.raises(InputError, match=r"zero.h5:/volume: found 1 voxels that are NaN"):
        run_bench(job, no_runtime)
    (job.volumes / "damaged_24.h5").write_text("not HDF5")
    with pytest.raises(InputError, match="damaged_24.h5"):
        run_bench(job, no_runtime)
    assert lines_of(job) == []


def test_tables_alone_need_no_device_but_results(made: BenchJob, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(InputError, match="no results"):
        remake_tables(replace(made, output=made.volumes / "none"))
    results = made.output / RESULTS
    results.write_text("".join(row for row in results.open() if '"PhyRadGS w/o ST"' not in row))
    table = remake_tables(made)[0]
    before = table.read_text()
    assert "| PhyRadGS w/o ST | – |" in before
    with pytest.raises(InputError, match="found only volumes at 12³; volumes at 12³ with 8"):
        remake_tables(replace(made, size="S", rows=["PhyRadGS"]))
    other = remake_tables(replace(made, iterations=9))[0]
    assert "splats with 9 iterations; those with 8 have one of their own" in caplog.text
    assert "| PhyRadGS | – |" in other.read_text() and other != table
    shutil.rmtree(made.output / "slices")
    assert [path.suffix for path in remake_tables(made)] == [".md", ".csv"] and table.read_text() == before
    assert re.search(r"no slices of (\d) of \1 pictures", caplog.text)


def test_tables_alone_may_be_of_some_volumes_and_seeds(made: BenchJob, rt: Runtime) -> None:
    made = replace(made, rows=["FDK"])
    whole = run_bench(replace(made, names=["ball"], seeds=[1]), lambda: rt)[0].read_text()
    of_ball = remake_tables(replace(made, names=["ball"]), seeds=[0])[0].read_text()
    assert "Seeds 0, 1:" in whole and "| ball | box |" in whole
    assert "Seeds 0:" in of_ball and "| box |" not in of_ball
    with pytest.raises(InputError, match="--names: found 'bull'"):
        remake_tables(replace(made, names=["bull"]))
    assert remake_tables(made)[0].read_text() == whole


def test_a_partial_run_loses_no_line_of_a_table(made: BenchJob, rt: Runtime) -> None:
    run_bench(replace(made, rows=["FDK"], protocols=["standard"]), lambda: rt)
    job = replace(made, protocols=["rapid", "standard"])
    tables = remake_tables(job)
    before = {path: path.read_bytes() for path in tables}
    partial = replace(made, rows=["FDK"], names=["ball"])
    for written in (run_bench(partial, no_runtime), remake_tables(replace(partial, names=None))):
        assert written == tables and {path: path.read_bytes() for path in tables} == before
    run_bench(replace(partial, rows=["SART micro-views"], names=["box"]), lambda: rt)
    grown = {path: path.read_text() for path in tables if path.suffix != ".png"}
    assert all("SART micro-views" in text for text in grown.values())
    remake_tables(job)
    assert {path: path.read_text() for path in grown} == grown


def test_a_name_stands_for_one_object(made: BenchJob) -> None:
    results, folder = made.output / RESULTS, made.volumes
    whole, lines = results.read_bytes(), lines_of(made)
    assert all(re.fullmatch("[0-9a-f]{16}", line.pop("source_hash")) for line in lines)
    results.write_text("".join(json.dumps(line) + "\n" for line in lines))
    run_bench(made, no_runtime)  # lines without a hash go by the name of their file
    results.write_bytes(whole)
    other = folder / "other"
    other.mkdir()
    shutil.copy(folder / "box.h5", other / "ball.h5")
    with pytest.raises(InputError, match="runs of ball_24.h5 under the name 'ball', which is ball.h5 now"):
        run_bench(replace(made, volumes=other), no_runtime)
    shutil.copy(folder / "box.h5", folder / "ball_24.h5")
    with pytest.raises(InputError, match="runs of ball_24.h5 from before its contents changed"):
        run_bench(made, no_runtime)
    run_bench(replace(made, names=["box"]), no_runtime)


def test_stop_and_shoot_is_of_the_volumes_of_its_row(job: BenchJob, rt: Runtime) -> None:
    run_bench(replace(job, rows=["SIRT"]), lambda: rt)
    table = run_bench(replace(job, rows=["SIRT per-row"], names=["ball"]), lambda: rt)[0].read_text()
    still = {x["volume"]: x["metrics"] for x in lines_of(job) if x["acquisition"] == STILL}
    assert still["ball"]["psnr_db"] != pytest.approx(still["box"]["psnr_db"], abs=0.01)
    row = next(line for line in table.splitlines() if line.startswith("| SIRT per-row (1 of 2 volumes)"))
    assert f"| {still['ball']['psnr_db']:.2f} / {still['ball']['ssim']:.3f} |" in row


def test_an_interruption_loses_the_present_run_only(
    job: BenchJob, rt: Runtime, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that a method has answered with a part of a volume, one between two runs, one in a run's last iteration."""
    original = bench_run.reconstruct

    def stopped(*arguments: object, **named: object) -> object:
        result = original(*arguments, **named)  # type: ignore[arg-type]
        if result.facts["method"] == "phyradgs":
            result.facts["interrupted_at"] = 3
        return result

    def stop_after_two(progress: BenchProgress) -> None:
        if progress.number == 3:
            raise KeyboardInterrupt

    def pressed(*arguments: object, **named: object) -> object:
        with stop_on_interrupt():
            signal.raise_signal(signal.SIGINT)
        return original(*arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(bench_run, "reconstruct", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_bench(job, lambda: rt)
    assert [line["label"] for line in lines_of(job)] == ["FDK"]
    monkeypatch.undo()
    with pytest.raises(KeyboardInterrupt):
        run_bench(job, lambda: rt, stop_after_two)
    assert len(lines_of(job)) == 2
    monkeypatch.setattr(bench_run, "reconstruct", pressed)
    with pytest.raises(KeyboardInterrupt):
        run_bench(replace(job, rows=["FDK"], names=["box"]), lambda: rt)
    assert len(lines_of(job)) == 3
    monkeypatch.undo()
    run_bench(job, lambda: rt)
    assert len(lines_of(job)) == RUNS


def test_a_run_that_overflows_is_noted_and_tried_again(
    fdk: BenchJob, rt: Runtime, monkeypatch: pytest.MonkeyPatch
) -> None:
    def overflow(*_: object, **__: object) -> object:
        raise NumericalError("projections", "values that overflow")

    monkeypatch.setattr(bench_run, "reconstruct", overflow)
    seen: list[BenchProgress] = []
    with pytest.raises(InputError):  # nothing to make a table of
        run_bench(fdk, lambda: rt, seen.append)
    assert "failed: projections" in result_text(seen[-1])
    monkeypatch.undo()
    run_bench(fdk, lambda: rt)
    assert len(lines_of(fdk)) == 4


def test_stop_and_shoot_stands_at_the_mid_window_poses() -> None:
    geometry = ConeGeometry(5.0, 7.0, (8, 8), (0.5, 0.5))
    for protocol in (PROTOCOLS["rapid"], PROTOCOLS["standard"]):
        shutter, start_s = protocol.shutter(), protocol.frame_start_s()
        moving, still = protocol.orbit(geometry), stop_and_shoot(protocol).orbit(geometry)
        between = held_out(protocol).orbit(geometry)
        for frame in range(protocol.views):
            middle_s = np.array([start_s[frame] + shutter.span_s / 2])
            for time_s in (middle_s, middle_s + 0.3):
                np.testing.assert_allclose(still.pose(frame, time_s), moving.pose(frame, middle_s), atol=1e-9)
            turn = between.angle_rad(frame, middle_s) - still.angle_rad(frame, middle_s)
            np.testing.assert_allclose(turn, np.pi / protocol.views, atol=1e-9)


def test_both_scans_of_a_case_agree_in_poses_and_truth(rt: Runtime) -> None:
    geometry = ConeGeometry(5.0, 7.0, (16, 16), (0.25, 0.25))
    scene = phantom_scene(rt, "jaw", geometry, Grid.cube(12, 2.0), 12, "columns", 0)
    case = SyntheticCase(rt, scene, geometry, PROTOCOLS["rapid"], "columns", 0)
    fly, still = case.scan(FLY), case.scan(STILL)
    assert (fly.is_fly, still.is_fly) == (True, False)
    np.testing.assert_allclose(*(Static().cells(scan, 24).pose for scan in (fly, still)), atol=1e-9)
    assert case.scan(FLY) is fly and case.measure(case.truth)["psnr_db"] == np.inf


def test_held_out_views_of_the_source_itself_are_equal(rt: Runtime) -> None:
    geometry = ConeGeometry(5.0, 7.0, (16, 16), (0.25, 0.25))
    scene = phantom_scene(rt, "jaw", geometry, Grid.cube(12, 2.0), 12, "rows", 0)
    views = HeldOutViews(rt, scene.source, geometry, scene.grid, PROTOCOLS["rapid"], "rows")
    found = views.measure(scene.reference)
    assert found["psnr_2d_db"] > 30  # the block mean of the source, seen on coarser voxels
    assert views.measure(0.9 * scene.reference)["psnr_2d_db"] < found["psnr_2d_db"]


def test_raw_counts_come_back_as_line_integrals() -> None:
    clean = np.random.default_rng(0).uniform(0, 2, (6, 32, 32))
    frames, unusable = measured_attenuation(clean, Panel(), np.random.default_rng(1))
    assert not unusable.any()
    # variance of −ln of counts: 1/counts + (σ/counts)², and that of ten flats
    counts = 5e4 * np.exp(-clean)
    expected = np.sqrt(np.mean((1 / counts + 100 / counts**2) + 0.1 / 5e4))
    assert np.std(frames - clean) == pytest.approx(expected, rel=0.1)
    assert abs(np.mean(frames - clean)) < expected / 10
    dim, _ = measured_attenuation(clean, Panel(dose=500.0), np.random.default_rng(1))
    assert np.std(dim - clean) > 5 * expected


def test_the_sphere_phantom_study_runs_and_says_shape(tmp_path: Path, rt: Runtime) -> None:
    job = BenchJob("phantom", tmp_path / "out", size=BenchSize("T", 40, 32, 8), rows=["FDK", "PhyRadGS"])
    run_bench(job, lambda: rt)
    lines = {(x["label"], x["acquisition"]): x["metrics"] for x in read_lines(job.output / RESULTS)}
    references = {("truth", "reference"), ("pseudo-truth", "reference")}
    runs = {("FDK", FLY), ("PhyRadGS", FLY), ("FDK", STILL), ("PhyRadGS w/o ST", STILL)}
    assert set(lines) == references | runs
    scores = {"psnr_db", "psnr_db_pseudo", "psnr_2d_db", "roundness", "edge_rise_mm"}
    assert lines["PhyRadGS", FLY].keys() >= scores
    pseudo = next(job.output.glob("pseudo_truth_*.h5"))
    before = pseudo.stat().st_mtime_ns
    run_bench(replace(job, rows=["FDK", "PhyRadGS", "R2-Gaussian"]), lambda: rt)
    assert pseudo.stat().st_mtime_ns == before
    text = (job.output / "phantom_T.md").read_text()
    assert "| pseudo-truth |" in text and "R2-Gaussian" in text


def test_the_phantoms_scan_is_the_papers_kind(rt: Runtime) -> None:
    case = PhantomCase(rt, BenchSize("T", 64, 24, 8), PROTOCOLS["rapid"], "rows", 0, lambda: np.ones(1))
    fly, still = case.scan(FLY), case.scan(STILL)
    assert (fly.detector_model, fly.geometry.source_to_detector_mm) == ("intensity", 1200.0)
    assert min(map(abs, fly.geometry.detector_offset_mm)) > 0
    assert 1.5 < still.projections.max() < 5
    shape = case.shape(case.truth)
    assert (shape["bias_balls"], shape["bias_holder"]) == pytest.approx((0, 0), abs=1e-6)
    assert shape["round_sections"] == 3 * shape["edge_balls"] > 0
    assert {HOLDER, BEADS} <= set(np.unique(case._labels()))


def test_every_ball_of_the_phantom_has_surroundings_of_its_own() -> None:
    """The shape metrics look out to 1.75 radii: no other bead, and no end of the holder, may be there."""
    _, grid = c_arm(BenchSize("T", 40, 24, 8))
    phantom = phantom_in(grid)
    holder = phantom.ellipsoids[0].attenuation_per_mm
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(3, 500))
    directions /= np.linalg.norm(directions, axis=0)
    for bead in beads_of(phantom):
        for share in (1.01, 1.4, 1.75):
            points = np.array(bead.centre_mm)[:, None] + share * bead.radius_mm * directions
            np.testing.assert_allclose(phantom.density(*points), holder)


def test_the_command_runs_resumes_and_makes_tables(
    job: BenchJob, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sizes.SIZES, "XS", replace(TINY, name="XS"))
    out = ["--volumes", str(job.volumes), "-o", str(job.output), "--size", "XS", "--protocols", "rapid"]
    command = ["table1", *out, "--rows", "FDK"]
    assert run(["--help"]) == 0
    assert "Example: python benchmarks/tables table1" in capsys.readouterr().out
    assert run(command) == 0
    first = capsys.readouterr().out
    assert "FDK (fly-scan): PSNR" in first
    assert run([*command, "--table-only"]) == 0
    again = capsys.readouterr().out.splitlines()
    assert again == [line for line in first.splitlines() if line.startswith(str(tmp_path))]
    assert run([*command, "--rows", "PhyRadSG"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("phyradgs: --rows: found 'PhyRadSG'") and error.count("\n") == 1
    assert run(["table1", "--volumes", str(job.output), "-o", str(tmp_path / "none")]) == 2
    assert not (tmp_path / "none").exists() and lines_of(job)[0]["size"] == "XS"


def test_other_iterations_and_readouts_have_tables_of_their_own(tmp_path: Path) -> None:
    job = BenchJob("table1", tmp_path)
    assert job.stem == replace(job, iterations=3000).stem == "table1_S"
    assert replace(job, iterations=10, axis="columns").stem == "table1_S_i10_columns"
