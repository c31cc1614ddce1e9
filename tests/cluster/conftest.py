"""Tests of Dask's workers: `make test-cluster`. Without the extra there is nothing here to run."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from cluster.processes import stop

from phyradgs_cl.acquisition import ConeGeometry, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_scan
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate

collect_ignore_glob = [] if importlib.util.find_spec("distributed") else ["test_*.py"]
Start = Callable[..., subprocess.Popen]


@pytest.fixture
def sweep_folder(rt: Runtime, tmp_path: Path) -> Path:
    """Two tiny scans and a grid of forty runs of half a second or more."""
    geometry = ConeGeometry(5.0, 7.0, (12, 12), (1 / 3, 1 / 3))
    scene = phantom_scene(rt, "jaw", geometry, Grid.cube(10, 2.0), 10, "rows", 0)
    options = SimulationOptions(protocol=make_protocol("rapid", views=4), time_samples=2)
    write_scan(
        tmp_path / "a.h5", simulate(scene.source, geometry, scene.grid, options, reference=scene.reference)
    )
    shutil.copy(tmp_path / "a.h5", tmp_path / "b.h5")
    (tmp_path / "grid.toml").write_text(
        'scans = ["*.h5"]\nseeds = [0, 1]\n[[grid]]\nmethod = "sirt"\n'
        'motion = ["static", "per-row"]\niterations = [300, 350, 400, 450, 500]\n'
    )
    return tmp_path


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a process in a group of its own; whatever is left of the group is killed with the test."""
    started: list[subprocess.Popen] = []

    def starting(*command: str, log: Path, **named: object) -> subprocess.Popen:
        with open(log, "a") as file:
            process = subprocess.Popen(
                [sys.executable, *command], stdout=file, stderr=file, start_new_session=True, **named
            )
        started.append(process)
        return process

    yield starting
    for process in started:
        stop(process)
