"""Workers: one device and one run at a time each, deadly runs given up, and the messages where there are none."""

import os
import signal
from pathlib import Path

import pytest
from cluster.processes import free_port

from phyradgs_cl.runtime import DEVICE_VARIABLE, list_devices
from phyradgs_cl.workflow import sweep as sweep_run
from phyradgs_cl.workflow.sweep import Line, plan_sweep, read_lines, run_sweep


def where(run: object, device: str | None = None) -> Line:
    """In place of a run: which process has which device."""
    return {**run.facts, "metrics": {}, "seconds": 0.1, "device": os.environ[DEVICE_VARIABLE], "pid": os.getpid()}


def deadly(run: object, device: str | None = None) -> Line:
    """Kills the worker at one of the runs."""
    if run.facts["seed"] == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return where(run)


def lines_of(folder: Path, grid: str, workers: str, device: str) -> list[Line]:
    (folder / "grid.toml").write_text(grid)
    run_sweep(plan_sweep(folder / "grid.toml", folder / "out"), folder / "out", workers, device)
    return read_lines(folder / "out" / "results.jsonl")


def test_each_worker_has_a_device_and_dask_writes_its_page(sweep_folder, monkeypatch) -> None:
    monkeypatch.setattr(sweep_run, "make_run", where)
    lines = lines_of(sweep_folder, 'scans = ["*.h5"]\nseeds = [0, 1, 2, 3]\n[[runs]]\n', "2", "cpu,0")
    index = next(str(one.index) for one in list_devices() if one.kind == "cpu")
    assert len(lines) == 8 and {line["device"] for line in lines} == {index, "0"}
    assert len({line["pid"] for line in lines}) == 2  # processes that stay
    assert "<html" in (sweep_folder / "out" / "workers.html").read_text().lower()


def test_a_run_that_kills_every_worker_is_given_up_and_the_others_are_made(sweep_folder, monkeypatch) -> None:
    monkeypatch.setattr(sweep_run, "make_run", deadly)
    lines = lines_of(sweep_folder, 'scans = ["a.h5"]\nseeds = [0, 1, 2, 3]\n[[runs]]\n', "1", "cpu")
    failed = [line for line in lines if "error" in line]
    assert len(lines) == 4 and [line["seed"] for line in failed] == [1] and "KilledWorker" in failed[0]["error"]


def test_no_scheduler_is_one_line(cli, tiny_scan, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid = tmp_path / "grid.toml"
    grid.write_text(f'scans = ["{tiny_scan}"]\n[[runs]]\nmethod = "fdk"\n')
    for address in (f"tcp://127.0.0.1:{free_port()}", "nonsense://x"):
        assert cli.run(["sweep", str(grid), "-o", str(tmp_path / "out"), "--workers", address]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and f"--workers {address}: found no answer" in error
