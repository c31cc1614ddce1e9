"""The workers: one device each, their exceptions, and the messages where they are missing."""

import os
import shutil
import signal
import time
from pathlib import Path

import pytest
from cluster.processes import free_port, wait_until

from phyradgs_cl import cluster as cluster_module
from phyradgs_cl.cluster import Lost, Pool, Workers
from phyradgs_cl.errors import InputError
from phyradgs_cl.runtime import DEVICE_VARIABLE


def device_of(number: int) -> tuple[int, str, int]:
    time.sleep(0.3)
    return number, os.environ[DEVICE_VARIABLE], os.getpid()


def die(number: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return number


def refuse(number: int) -> int:
    raise InputError("--option", str(number), "another")


def test_each_worker_has_a_device_and_gets_one_run_at_a_time() -> None:
    with Pool(Workers(count=2, device="cpu,0")) as pool:
        assert pool.dashboard.startswith("http://127.0.0.1:")
        running: list[int] = []
        arguments = {f"run-{n}": n for n in range(8)}
        found = dict(pool.results(device_of, arguments, lambda now, devices: running.append(now)))
    assert [found[f"run-{n}"][0] for n in range(8)] == list(range(8))
    assert {device for _, device, _ in found.values()} == {"cpu", "0"}
    assert len({pid for _, _, pid in found.values()}) == 2  # processes that stay
    assert max(running) == 2


def test_a_run_that_kills_every_worker_is_given_up_and_the_others_are_made() -> None:
    with Pool(Workers(count=1, device="cpu")) as pool:
        found = dict(pool.results(die, {"deadly": 1}))
        assert isinstance(found["deadly"], Lost) and "4 workers died" in found["deadly"].reason
        assert [pair[1][0] for pair in pool.results(device_of, {"harmless": 3})] == [3]
        with pytest.raises(InputError, match="--option: found 7"):
            list(pool.results(refuse, {"run": 7}))


def test_no_scheduler_is_one_line(cli, tiny_scan, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid = tmp_path / "grid.toml"
    grid.write_text(f'scans = ["{tiny_scan}"]\n[[runs]]\nmethod = "fdk"\n')
    for where in (f"tcp://127.0.0.1:{free_port()}", str(tmp_path / "none.json"), "nonsense://x"):
        assert cli.run(["sweep", str(grid), "-o", str(tmp_path / "out"), "--scheduler", where]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and f"--scheduler {where}: found no answer" in error


def test_workers_without_the_resource_are_waited_for(sweep_folder, start, tmp_path) -> None:
    port, log = free_port(), tmp_path / "log.txt"
    options = ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    start("-m", "dask", "scheduler", *options, log=tmp_path / "scheduler.txt")
    address = f"tcp://127.0.0.1:{port}"
    worker = ["-m", "dask", "worker", address, "--nthreads", "1", "--no-dashboard"]
    start(*worker, log=tmp_path / "workers.txt", cwd=tmp_path)
    (sweep_folder / "grid.toml").write_text('scans = ["a.h5"]\n[[runs]]\nmethod = "fdk"\n')
    command = ["-m", "phyradgs_cl", "sweep", str(sweep_folder / "grid.toml"), "-o", str(tmp_path / "out")]
    sweep = start(*command, "--scheduler", address, log=log)
    wait_until(lambda: "no worker with the resource device" in log.read_text(), 60, log.read_text)
    start(*worker, "--resources", "device=1", log=tmp_path / "workers.txt", cwd=tmp_path)
    wait_until(lambda: sweep.poll() is not None, 90, log.read_text)
    assert sweep.returncode == 0, log.read_text()
    shutil.rmtree(tmp_path / "out")


def test_local_workers_that_are_all_gone_are_started_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when workers are killed while they start: their nannies give up."""
    monkeypatch.setattr(cluster_module, "_WITHOUT_WORKERS_S", 1.0)
    with Pool(Workers(count=1, device="cpu")) as pool:
        found = pool.results(device_of, {f"run-{n}": n for n in range(3)})
        first = next(found)[1]
        for nanny in pool._cluster.workers.values():
            pool._cluster.sync(nanny.close)
        rest = [value for _, value in found]
    assert sorted([first[0], *(number for number, _, _ in rest)]) == [0, 1, 2]
    assert rest[-1][2] != first[2]
