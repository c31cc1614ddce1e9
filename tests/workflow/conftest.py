"""A tiny scan with its truth, simulated once."""

from __future__ import annotations

from pathlib import Path

import pytest

from phyradgs_cl.acquisition import ConeGeometry, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_scan
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate


@pytest.fixture(scope="session")
def tiny_scan(rt: Runtime, tmp_path_factory: pytest.TempPathFactory) -> Path:
    geometry = ConeGeometry(5.0, 7.0, (12, 12), (1 / 3, 1 / 3))
    scene = phantom_scene(rt, "jaw", geometry, Grid.cube(10, 2.0), 10, "rows", 0)
    options = SimulationOptions(protocol=make_protocol("rapid", views=4), time_samples=2)
    path = tmp_path_factory.mktemp("tiny") / "tiny.h5"
    write_scan(path, simulate(scene.source, geometry, scene.grid, options, reference=scene.reference))
    return path
