"""Tests of Dask's workers: `make test-cluster`. Without the extra there is nothing here to run."""

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cluster.processes import stop

collect_ignore_glob = [] if importlib.util.find_spec("distributed") else ["test_*.py"]
Start = Callable[..., subprocess.Popen]


@pytest.fixture
def sweep_folder(tiny_scan: Path, tmp_path: Path) -> Path:
    """Two tiny scans and a grid of forty runs of half a second or more."""
    for name in ("a.h5", "b.h5"):
        shutil.copy(tiny_scan, tmp_path / name)
    (tmp_path / "grid.toml").write_text(
        'scans = ["*.h5"]\nseeds = [0, 1]\n[[grid]]\nmethod = "sirt"\n'
        'motion = ["static", "per-row"]\niterations = [300, 350, 400, 450, 500]\n'
    )
    return tmp_path


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a process in a new group, which is killed at the end of the test."""
    started: list[subprocess.Popen] = []

    def starting(*command: str, log: Path, **named: object) -> subprocess.Popen:
        with open(log, "a") as file:
            own = {"stdout": file, "stderr": file, "start_new_session": True}
            started.append(subprocess.Popen([sys.executable, *command], **own, **named))
        return started[-1]

    yield starting
    for process in started:
        stop(process)
