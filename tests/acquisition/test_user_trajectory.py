"""Poses and angles of a user's own classes are checked wherever they are used."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Scan, Shutter
from phyradgs_cl.acquisition.trajectory import CircularOrbit, ConstantSpeed
from phyradgs_cl.api import ray_operator, splat_operator
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

CONE, PARALLEL = ConeGeometry(500.0, 800.0, (5, 6), 6.0), ParallelGeometry((5, 6), 6.0)


@dataclass(frozen=True)
class Own:
    change: Any = staticmethod(lambda poses: poses)
    geometry: ConeGeometry | ParallelGeometry = CONE

    @property
    def is_parallel(self) -> bool:
        return self.geometry is PARALLEL

    def pose(self, frame: int, time_s: np.ndarray) -> Any:
        return self.change(CircularOrbit(self.geometry, ConstantSpeed(0.0, 0.5)).pose(frame, time_s))


def scan_of(trajectory: object, geometry: ConeGeometry | ParallelGeometry = CONE) -> Scan:
    shutter, grid = Shutter(0.4, 0.3), Grid.cube(6, 40.0)
    return Scan(np.ones((3, 5, 6), np.float32), geometry, trajectory, shutter, np.arange(3.0), grid)  # type: ignore[arg-type]


@pytest.mark.parametrize(("change", "found"), [
    (lambda poses: poses[0], r"shape \(12,\)"), (lambda poses: poses[..., :9], r"shape \(\d+, 9\)"),
    (lambda poses: np.nan * poses, "NaN"), (lambda poses: poses.astype(str), "expected numbers"),
])  # fmt: skip
def test_poses_of_no_use_are_refused_by_every_operator(rt, change, found) -> None:
    scan = scan_of(Own(change))
    for made in (lambda: ray_operator(scan, "static"), lambda: ray_operator(scan), lambda: splat_operator(scan)):
        with pytest.raises(InputError, match=f"trajectory Own: .*{found}"):
            made()
    with pytest.raises(InputError, match=f"trajectory Own: .*{found}"):
        scan.astra_vectors()


def test_lists_serve_and_directions_may_have_any_length() -> None:
    times_s = np.array([0.1, 0.2])
    expected = Own().pose(0, times_s)
    np.testing.assert_array_equal(scan_of(Own(np.ndarray.tolist)).trajectory.pose(0, times_s), expected)
    long = Own(lambda poses: poses * np.repeat([2.0, 1.0], [3, 9]), PARALLEL)
    plain = Own(geometry=PARALLEL).pose(0, times_s)
    np.testing.assert_allclose(scan_of(long, PARALLEL).trajectory.pose(0, times_s), plain)


@pytest.mark.parametrize("angle", [np.nan, [0.0, 1.0, 2.0], "none"])
def test_angles_of_no_use_are_refused(angle) -> None:
    class Kinematics:
        def angle_rad(self, frame: int, time_s: np.ndarray) -> Any:
            return angle if isinstance(angle, (list, str)) else np.full(np.shape(time_s), angle)

    with pytest.raises(InputError, match="kinematics Kinematics"):
        scan_of(CircularOrbit(CONE, Kinematics())).trajectory.pose(0, np.zeros(2))
