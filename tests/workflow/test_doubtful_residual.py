"""reconstruct ends with a line where the volume leaves much more of a scan than its noise: such a scan cannot be right."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, Scan, make_protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_scan
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate

pytestmark = pytest.mark.slow
LINE = "the volume does not explain"


@pytest.fixture(scope="module")
def fly(rt) -> Scan:
    """A fly-scan of 25 views."""
    geometry = ConeGeometry(5.0, 7.0, (32, 32), (0.125, 0.125))
    scene = phantom_scene(rt, "jaw", geometry, Grid.cube(24, 2.0), 24, "rows", 0)
    options = SimulationOptions(make_protocol("rapid"), "rows", noise="tigre", dose=1e4, time_samples=8)
    return replace(simulate(scene.source, geometry, scene.grid, options), reference=None)


def of_photons(scan: Scan, photons: float) -> Scan:
    counts = np.random.default_rng(1).poisson(photons * np.exp(-scan.projections.astype(float)))
    return replace(scan, projections=np.log(photons / np.maximum(counts, 0.5)).astype(np.float32))


def stated(scan: Scan, frames: np.ndarray | None = None, **geometry: object) -> Scan:
    """The same frames, or others, with another geometry."""
    panel = replace(scan.geometry, **geometry)
    frames = scan.projections if frames is None else np.ascontiguousarray(frames, np.float32)
    return replace(scan, projections=frames, geometry=panel, trajectory=CircularOrbit(panel, scan.trajectory.kinematics))


RIGHT = {
    "1000 photons": lambda scan: of_photons(scan, 1000),
    "truncated": lambda scan: stated(scan, scan.projections[:, :, 8:24], detector_shape=(32, 16)),
}
WRONG = {
    "axis off by 7 pixels": lambda scan: stated(scan, detector_offset_mm=(0.0, 7 * 0.125)),
    "no flats": lambda scan: stated(scan, scan.projections - np.log(2e4)),
}


@pytest.mark.parametrize("name", [*RIGHT, *WRONG])
def test_a_residual_beyond_the_noise_is_said(cli, fly, tmp_path, caplog, name) -> None:
    write_scan(tmp_path / "scan.h5", {**RIGHT, **WRONG}[name](fly))
    assert cli.run(["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "volume.h5")]) == 0
    assert (LINE in caplog.text) == (name in WRONG)
