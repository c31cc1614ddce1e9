"""Small noisy scans of a phantom, whose frames last as long as they are apart or less, turned one way and the other."""

from collections.abc import Callable
from functools import cache

import pytest

from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate


@pytest.fixture(scope="session")
def turned(rt) -> Callable[..., Scan]:
    """The scan with the gantry turning on or back, and this detector model; made once and not to be written to."""

    @cache
    def make(back: bool = False, model: str = "log", axis: str = "rows") -> Scan:
        geometry = ConeGeometry(5.0, 7.0, (32, 32), (0.125, 0.125))
        scene = phantom_scene(rt, "jaw", geometry, Grid.cube(24, 2.0), 24, axis, 0)
        plan = Protocol(views=11, exposure_deg=16.0, readout_ratio=0.5, turns=-1.0 if back else 1.0)
        options = SimulationOptions(plan, axis, noise="tigre", dose=1e6, time_samples=8, detector_model=model)
        return simulate(scene.source, geometry, scene.grid, options)

    return make


@pytest.fixture(scope="session")
def right(turned) -> Scan:
    return turned()
