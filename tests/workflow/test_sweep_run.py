"""Sweeps in one process: resumed, failures noted and tried again, results and tables, and a message without Dask."""

import csv
import json
import os
import shutil
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from phyradgs_cl.cluster import Workers
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import only_run, read_volume
from phyradgs_cl.io.output import BusyError
from phyradgs_cl.settings import read_config
from phyradgs_cl.workflow.sweep import (
    RESULTS,
    SweepJob,
    SweepProgress,
    plan_sweep,
    read_grid,
    run_sweep,
)
from phyradgs_cl.workflow.sweep import run as sweep_run
from phyradgs_cl.workflow.sweep.tables import comma_separated, markdown, read_lines

TEXT = """
scans = ["*.h5"]
seeds = [0, 1]
[[grid]]
method = "sirt"
iterations = [2, 4]
[[runs]]
method = "fdk"
"""
RUNS = 2 * 3 * 2


@pytest.fixture
def job(tmp_path: Path, tiny_scan: Path) -> SweepJob:
    for name in ("a.h5", "b.h5"):
        shutil.copy(tiny_scan, tmp_path / name)
    path = tmp_path / "grid.toml"
    path.write_text(TEXT)
    return SweepJob(read_grid(read_config(path, "GRID"), path), tmp_path / "out")


@pytest.fixture
def no_dask(monkeypatch: pytest.MonkeyPatch) -> None:
    from phyradgs_cl.commands import sweep

    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setattr(sweep, "has_dask", lambda: False)


def lines_of(job: SweepJob) -> list[dict]:
    return read_lines(job.folder / RESULTS)


def records_of(job: SweepJob) -> list[dict]:
    with open(job.folder / "results.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_every_run_is_in_the_file_once_with_what_it_depends_on(job) -> None:
    """In the tables too; a scan that was replaced is run again."""
    told: list[SweepProgress] = []
    written, failed = run_sweep(job, told.append)
    lines = lines_of(job)
    assert failed == 0 and [path.name for path in written] == ["results.jsonl", "results.md", "results.csv"]
    assert len(lines) == RUNS == len({line["run"] for line in lines})
    needed = {"version", "device", "seed", "options", "seconds", "metrics", "numpy", "python", "scan", "host"}
    assert all(needed <= line.keys() and {"psnr_db", "ssim"} <= line["metrics"].keys() for line in lines)
    stored = read_volume(job.folder / lines[0]["volume"])
    assert stored.metrics["psnr_db"] == pytest.approx(lines[0]["metrics"]["psnr_db"])
    assert [p.done for p in told if p.line is not None] == list(range(1, RUNS + 1))
    assert any(p.progress is not None for p in told)
    text = (job.folder / "results.md").read_text()
    (row,) = [line for line in text.splitlines() if line.startswith("| sirt iterations=4 |")]
    scores = [line["metrics"]["psnr_db"] for line in lines if line["label"] == "sirt iterations=4"]
    assert row.split("|")[2].strip() == "4" and f"{sum(scores) / 4:.2f} ±" in row
    assert {record["iterations"] for record in records_of(job)} == {"2", "4", ""}
    assert all((job.folder / record["volume"]).is_file() for record in records_of(job))
    scan = job.grid.scans[0]
    os.utime(scan, ns=(1, 1))
    run_sweep(job)
    again = lines_of(job)[RUNS:]
    assert len(again) == RUNS // 2 and {line["scan"] for line in again} == {str(scan)}
    assert len(records_of(job)) == RUNS


def test_tables_have_held_out_errors_where_they_were_asked_for() -> None:
    line = {"label": "one", "seconds": 1.0, "metrics": {}, "input": {}, "changes": {}}
    held_out = {**line, "metrics": {"holdout_rms": 0.01234, "holdout_noise_rms": 0.0111}}
    assert "held-out" not in markdown([line], 1)
    title, _, row = markdown([held_out], 1).splitlines()[2:]
    assert "| held-out RMS | noise RMS |" in title and "| 0.01234 | 0.0111 |" in row
    assert "holdout_rms" in comma_separated([held_out]) and "0.01234" in comma_separated([held_out])


def test_a_sweep_goes_on_where_it_was_stopped(job) -> None:
    def stop_after_five(p: SweepProgress) -> None:
        if p.line is not None and p.done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_sweep(job, stop_after_five)
    assert len(lines_of(job)) == 5
    whole = (job.folder / RESULTS).read_bytes()
    (job.folder / RESULTS).write_bytes(whole[:-30])  # killed while the last line was written
    told: list[SweepProgress] = []
    run_sweep(job, told.append)
    lines = lines_of(job)
    assert len(lines) == RUNS == len({line["run"] for line in lines})
    assert [p.done for p in told if p.line is not None] == list(range(5, RUNS + 1))
    run_sweep(job, told.append)
    assert len(lines_of(job)) == RUNS


def test_a_result_that_was_lost_on_its_way_is_not_made_again(job) -> None:
    run = plan_sweep(job.grid, job.folder)[0]
    run.output.parent.mkdir(parents=True)
    first = sweep_run.make_run(run)
    made_ns = run.output.stat().st_mtime_ns
    assert sweep_run.make_run(run) == first and run.output.stat().st_mtime_ns == made_ns
    run.output.unlink()  # a removed volume is made again
    assert sweep_run.make_run(run)["finished"] >= first["finished"] and run.output.exists()


def test_failures_are_noted_and_tried_again(job, monkeypatch) -> None:
    original = sweep_run.resume_or_restart

    def failing(given, *rest):
        if given.method == "fdk" and given.seed == 1:
            raise InputError("scan", "no good | at all")
        if given.method == "fdk":
            raise ZeroDivisionError("a defect")
        return original(given, *rest)

    monkeypatch.setattr(sweep_run, "resume_or_restart", failing)
    _, failed = run_sweep(job)
    errors = [line["error"] for line in lines_of(job) if "error" in line]
    assert failed == 4 and set(errors) == {"ZeroDivisionError: a defect", "scan: found no good | at all"}
    text = (job.folder / "results.md").read_text()
    assert f"{RUNS - 4} of {RUNS} runs, 4 failed" in text and "no good \\| at all" in text
    monkeypatch.undo()
    _, failed = run_sweep(job)
    assert failed == 0 and len([line for line in lines_of(job) if "error" not in line]) == RUNS
    assert "failed run" not in (job.folder / "results.md").read_text()


def test_a_run_waits_for_one_that_its_scheduler_lost_sight_of(job, monkeypatch) -> None:
    run = plan_sweep(job.grid, job.folder)[0]
    run.output.parent.mkdir(parents=True)
    monkeypatch.setattr(sweep_run, "_BUSY_S", 0.03)
    with only_run(run.record):
        assert "another run" in sweep_run.make_run(run)["error"]
    monkeypatch.setattr(sweep_run, "_BUSY_S", 60.0)
    with ThreadPoolExecutor() as threads, only_run(run.record):
        waiting = threads.submit(sweep_run.make_run, run)
        time.sleep(0.5)
        assert not waiting.done()
    assert "error" not in waiting.result()


def test_the_command_needs_no_dask_for_one_run_after_the_other(cli, job, no_dask, refused, capfd) -> None:
    grid, install = job.folder.parent / "grid.toml", "pip install 'phyradgs-cl[cluster]'"
    command = ["sweep", str(grid), "-o", str(job.folder)]
    assert cli.run(command) == 0
    said = capfd.readouterr()
    assert f"{RUNS}/{RUNS} " in said.out and install in said.err
    with only_run(job.folder / RESULTS), pytest.raises(BusyError, match="another run"):
        run_sweep(job)
    (job.folder / RESULTS).unlink()
    for more in (["--workers", "2"], ["--scheduler", "local"], ["--scheduler", "tcp://host:1"]):
        refused([*command, *more], install)
    refused([*command, "--device", "cpu,cpu"], "one device")
    refused(["sweep", grid.with_name("none.toml"), "-o", job.folder])
    grid.write_text(TEXT.replace("iterations", "iteration"))
    refused(command)


def test_failed_runs_show_in_the_status(cli, job, no_dask, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sweep_run, "resume_or_restart", lambda *_: 1 / 0)
    assert cli.run(["sweep", str(job.folder.parent / "grid.toml"), "-o", str(job.folder)]) == 2
    assert f"{RUNS} runs failed" in capsys.readouterr().err


def test_devices_are_given_out_in_turn_and_contradictions_refused() -> None:
    assert Workers(device="cpu,0", count=3).devices() == ["cpu", "0", "cpu"]
    assert len(Workers(device="cpu").devices()) == 1
    for options, message in (
        ({"scheduler": "tcp://a:1", "count": 2}, "--workers: found 2 together with --scheduler"),
        ({"scheduler": "tcp://a:1", "device": "0"}, "--device: found '0' together with --scheduler"),
        ({"count": 0}, "--workers"),
        ({"scheduler": " "}, "--scheduler"),
        ({"device": "cpu,"}, "--device"),
    ):
        with pytest.raises(InputError, match=message):
            Workers(**options).devices()


def test_lines_are_json_without_nan(job, monkeypatch) -> None:
    original = sweep_run.resume_or_restart

    def perfect(*arguments):
        result, metrics = original(*arguments)
        return result, {**metrics, "psnr_db": float("inf")}

    monkeypatch.setattr(sweep_run, "resume_or_restart", perfect)
    run_sweep(job)
    rows = (job.folder / RESULTS).read_text().splitlines()
    lines = [json.loads(row, parse_constant=pytest.fail) for row in rows]
    assert {line["metrics"]["psnr_db"] for line in lines} == {None}
