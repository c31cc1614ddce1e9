"""A small noisy scan of a phantom, whose frames last as long as they are apart or less."""

from __future__ import annotations

import pytest

from phyradgs_cl.acquisition import ConeGeometry, Scan, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate


@pytest.fixture(scope="session")
def right(rt) -> Scan:
    geometry = ConeGeometry(5.0, 7.0, (32, 32), (0.125, 0.125))
    scene = phantom_scene(rt, "jaw", geometry, Grid.cube(24, 2.0), 24, "rows", 0)
    protocol = make_protocol("rapid", views=15, exposure_deg=12.0, readout_ratio=0.5)
    options = SimulationOptions(protocol, "rows", noise="tigre", dose=1e6, time_samples=8)
    return simulate(scene.source, geometry, scene.grid, options)
