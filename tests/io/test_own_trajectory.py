"""A trajectory of one's own: any class with ``pose(frame, time_s)`` reconstructs, and is saved as a table of poses."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, PoseTable, Scan, Shutter
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import read_scan, write_scan
from phyradgs_cl.reconstructors import RunPlan, method_options, reconstruct

pytestmark = pytest.mark.slow
GEOMETRY = ConeGeometry(500.0, 800.0, (9, 12), (6.0, 5.0))
TURN = CircularOrbit(GEOMETRY, ConstantSpeed(0.0, 0.5))


@dataclass(frozen=True)
class Wobbling:
    """A circle on which the whole gantry swings along the axis; ``jumps`` from frame to frame where it should not."""

    jumps: float = 0.0

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        pose = TURN.pose(frame, time_s).copy()
        pose[..., [2, 5]] += 2.0 * np.sin(3.0 * np.asarray(time_s))[..., None] + self.jumps * frame
        return pose


def scan_on(trajectory: Wobbling, every_s: float) -> Scan:
    frames = np.random.default_rng(0).uniform(0, 1, (10, 9, 12)).astype(np.float32)
    start_s = every_s * np.arange(10)
    return Scan(frames, GEOMETRY, trajectory, Shutter(0.4, 0.3), start_s, Grid.cube(6, 40.0), is_fly=True)


def apart_mm(table: PoseTable, scan: Scan) -> float:
    times = [(frame, start_s + np.linspace(0, 0.7, 57)) for frame, start_s in enumerate(scan.frame_start_s)]
    return max(np.abs(table.pose(*at) - scan.trajectory.pose(*at)).max() for at in times)


EVERY_S = {"with pauses": 1.25, "without": 0.7, "frames that overlap": 0.5, "samples between samples": 0.350001}


@pytest.mark.parametrize("every_s", EVERY_S.values(), ids=EVERY_S)
def test_it_is_saved_as_a_table_that_follows_it(tmp_path, every_s) -> None:
    """Where frames come every half span, samples of one lie between another's, where a table is right of itself."""
    scan = scan_on(Wobbling(), every_s)
    write_scan(tmp_path / "s.h5", scan)
    found = read_scan(tmp_path / "s.h5", counts_to_attenuation)
    assert isinstance(found.trajectory, PoseTable) and found.is_fly and apart_mm(found.trajectory, scan) <= 2e-4 * 5.0


def test_every_kind_of_method_follows_it(rt, tmp_path) -> None:
    scan = scan_on(Wobbling(), 1.25)
    write_scan(tmp_path / "s.h5", scan)
    stored = read_scan(tmp_path / "s.h5", counts_to_attenuation)
    for name, changes in {"fdk": {}, "sirt": {"iterations": 2}, "phyradgs": {"iterations": 2, "gaussians": 20}}.items():
        options = method_options(name, None, changes)
        own, table, circle = (
            reconstruct(s, RunPlan(name, options), rt).volume for s in (scan, stored, replace(scan, trajectory=TURN))
        )
        np.testing.assert_allclose(own, table, rtol=0, atol=2e-3 * np.abs(own).max(), err_msg=name)
        assert np.abs(own - circle).max() > 1e-2 * np.abs(own).max(), name


def test_what_no_table_can_hold_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="trajectory: found poses that .* samples per frame miss"):
        write_scan(tmp_path / "s.h5", scan_on(Wobbling(jumps=1.0), 0.5))
    assert not list(tmp_path.iterdir())
