"""A small scan of a phantom with closed-form line integrals, noise included."""

from collections.abc import Callable

import pytest

from phyradgs_cl.acquisition import ConeGeometry, Scan, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import EllipsoidPhantom
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate


@pytest.fixture(scope="session")
def scan_of(rt) -> Callable[..., Scan]:
    """A noisy fly-scan of a phantom with this cone; keywords go to the protocol."""

    def make(
        geometry: ConeGeometry, phantom: str | EllipsoidPhantom = "jaw", size: int = 24, axis: str = "rows",
        **protocol: object,
    ) -> Scan:
        scene = phantom_scene(rt, phantom, geometry, Grid.cube(size, 2.0), size, axis, 0)
        options = SimulationOptions(make_protocol("rapid", **protocol), axis, noise="tigre", dose=1e6, time_samples=8)
        return simulate(scene.source, geometry, scene.grid, options)

    return make


PANEL = ConeGeometry(5.0, 7.0, (32, 32), (0.125, 0.125))


@pytest.fixture(scope="session")
def clean(scan_of) -> Scan:
    return scan_of(PANEL, views=15, exposure_deg=24.0, readout_ratio=0.5)


@pytest.fixture(scope="session")
def still(scan_of) -> Scan:
    """Stop-and-shoot, which is asked less: for what no readout changes."""
    return scan_of(PANEL, views=15, exposure_deg=24.0, is_fly=False)
