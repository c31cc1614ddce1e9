"""Forty runs while workers are killed at random and the scheduler is restarted: forty results, each once."""

import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from cluster.processes import free_port, stop, wait_until

from phyradgs_cl.io import read_volume
from phyradgs_cl.runtime import DEVICE_VARIABLE, list_devices
from phyradgs_cl.workflow import sweep as sweep_run
from phyradgs_cl.workflow.sweep import RESULTS, Line, plan_sweep, read_lines, run_sweep

RUNS = 40


def command(folder: Path, *more: str) -> list[str]:
    where = [str(folder / "grid.toml"), "-o", str(folder / "out"), "--checkpoint-every", "0.2"]
    return ["-m", "phyradgs_cl", "sweep", *where, *more]


def lines_of(folder: Path) -> list[Line]:
    path = folder / "out" / RESULTS
    return read_lines(path) if path.exists() else []


def workers_of(process: subprocess.Popen) -> list[psutil.Process]:
    """The worker processes that a sweep, or a `dask worker`, has started."""
    try:
        children = psutil.Process(process.pid).children(recursive=True)
        return [child for child in children if any("spawn_main" in word for word in child.cmdline())]
    except psutil.NoSuchProcess:
        return []


def kill_a_worker(process: subprocess.Popen, rng: np.random.Generator) -> bool:
    found = workers_of(process)
    if not found:
        return False
    os.kill(found[int(rng.integers(len(found)))].pid, signal.SIGKILL)
    return True


def check_all(folder: Path, tmp: Path) -> None:
    """Forty lines, none twice, none an error; the volumes are those of a sweep that nobody disturbed."""
    lines = lines_of(folder)
    assert len(lines) == RUNS == len({line["run"] for line in lines})
    assert not [line for line in lines if "error" in line]
    run_sweep(plan_sweep(folder / "grid.toml", tmp / "alone"), tmp / "alone")
    for line in lines:
        volumes = (read_volume(root / line["volume"]).values for root in (folder / "out", tmp / "alone"))
        np.testing.assert_array_equal(*volumes)
    assert "40 of 40 runs, 0 failed" in (folder / "out" / "results.md").read_text()


def test_workers_killed_at_random_and_the_sweep_itself_once(sweep_folder, start, tmp_path) -> None:
    """Local workers: their scheduler lives in the sweep's own process, and is killed and started with it."""
    rng, log = np.random.default_rng(0), tmp_path / "log.txt"
    run = command(sweep_folder, "--workers", "2", "--device", "cpu")
    sweep = start(*run, log=log)
    kills, restarted, before = 0, False, 0
    deadline = time.monotonic() + 1500
    while sweep.poll() is None:
        assert time.monotonic() < deadline, log.read_text()
        time.sleep(float(rng.uniform(1.0, 4.0)))
        done = len(lines_of(sweep_folder))
        if done > before and kills < 10:  # all at work, not starting: that is tried three times only
            kills += kill_a_worker(sweep, rng)
            before = done
        if done > RUNS // 2 and not restarted:
            restarted, before = True, done
            workers = workers_of(sweep)
            sweep.kill()  # its workers see that it has gone
            sweep.wait()
            _, alive = psutil.wait_procs(workers, timeout=30)
            assert not alive
            sweep = start(*run, log=log)
    assert sweep.returncode == 0, log.read_text()
    assert restarted and kills >= 3
    check_all(sweep_folder, tmp_path)


def test_a_sweep_goes_on_at_a_new_scheduler(sweep_folder, start, tmp_path) -> None:
    """When the scheduler ends, the sweep ends with a message; the same command makes the missing runs."""
    rng, log, port = np.random.default_rng(1), tmp_path / "log.txt", free_port()
    address = f"tcp://127.0.0.1:{port}"

    def servers() -> list[subprocess.Popen]:
        """A scheduler and two workers."""
        scheduler = f"-m dask scheduler --host 127.0.0.1 --port {port} --no-dashboard".split()
        crew = f"-m dask worker {address} --nworkers 2 --nthreads 1 --no-dashboard".split()
        more = {"log": tmp_path / "dask.txt", "env": {**os.environ, "PHYRADGS_DEVICE": "cpu"}, "cwd": tmp_path}
        return [start(*words, **more) for words in (scheduler, crew)]

    first, crew = servers()
    sweep = start(*command(sweep_folder, "--workers", address), log=log)
    said = log.read_text
    wait_until(lambda: len(lines_of(sweep_folder)) > 5, 600, said)
    assert kill_a_worker(crew, rng)
    wait_until(lambda: len(lines_of(sweep_folder)) > 15, 600, said)
    stop(first)
    stop(crew)
    wait_until(lambda: sweep.poll() is not None, 60, said)
    assert sweep.returncode == 2 and "no answer" in said() and "repeat the command" in said()
    servers()
    again = start(*command(sweep_folder, "--workers", address), log=log)
    wait_until(lambda: again.poll() is not None, 900, said)
    assert again.returncode == 0, said()
    check_all(sweep_folder, tmp_path)


def where(run: object, device: str | None = None) -> Line:
    """In place of a run: which process has which device."""
    return {**run.facts, "metrics": {}, "seconds": 0.1, "device": os.environ[DEVICE_VARIABLE], "pid": os.getpid()}


def deadly(run: object, device: str | None = None) -> Line:
    """Kills the worker at one of the runs."""
    if run.facts["seed"] == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return where(run)


def lines_made(folder: Path, grid: str, workers: str, device: str) -> list[Line]:
    (folder / "grid.toml").write_text(grid)
    run_sweep(plan_sweep(folder / "grid.toml", folder / "out"), folder / "out", workers, device)
    return read_lines(folder / "out" / "results.jsonl")


def test_each_worker_has_a_device_and_dask_writes_its_page(sweep_folder, monkeypatch) -> None:
    monkeypatch.setattr(sweep_run, "make_run", where)
    lines = lines_made(sweep_folder, 'scans = ["*.h5"]\nseeds = [0, 1, 2, 3]\n[[runs]]\n', "2", "cpu,0")
    index = next(str(one.index) for one in list_devices() if one.kind == "cpu")
    assert len(lines) == 8 and {line["device"] for line in lines} == {index, "0"}
    assert len({line["pid"] for line in lines}) == 2  # processes that stay
    assert "<html" in (sweep_folder / "out" / "workers.html").read_text().lower()


def test_a_run_that_kills_every_worker_is_given_up_and_the_others_are_made(sweep_folder, monkeypatch) -> None:
    monkeypatch.setattr(sweep_run, "make_run", deadly)
    lines = lines_made(sweep_folder, 'scans = ["a.h5"]\nseeds = [0, 1, 2, 3]\n[[runs]]\n', "1", "cpu")
    failed = [line for line in lines if "error" in line]
    assert len(lines) == 4 and [line["seed"] for line in failed] == [1] and "KilledWorker" in failed[0]["error"]


def test_no_scheduler_is_one_line(cli, tiny_scan, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid = tmp_path / "grid.toml"
    grid.write_text(f'scans = ["{tiny_scan}"]\n[[runs]]\nmethod = "fdk"\n')
    for address in (f"tcp://127.0.0.1:{free_port()}", "nonsense://x"):
        assert cli.run(["sweep", str(grid), "-o", str(tmp_path / "out"), "--workers", address]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and f"--workers {address}: found no answer" in error
