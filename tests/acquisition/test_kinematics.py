"""θ(t) of every kind, and pose tables as a rigid body."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, EncoderTable, FrameSweeps
from phyradgs_cl.acquisition.trajectory import PoseTable, SpeedRamp, continued
from phyradgs_cl.errors import InputError

GEOMETRY = ConeGeometry(1000.0, 1500.0, (4, 6), (0.7, 0.5), (3.0, -8.0))
RIGID_TOLERANCE_MM = 1e-9  # slerp in float64 at 1.5 m
TIMES_S = np.array([0.0, 0.4, 1.3, 2.9])


def test_constant_speed_ramps_and_sweeps_that_go_on_through_the_readout() -> None:
    np.testing.assert_allclose(ConstantSpeed(0.5, -0.2).angle_rad(3, TIMES_S), [0.5, 0.42, 0.24, -0.08])
    ramp = SpeedRamp(0.5, 0.2, 0.1).angle_rad(0, TIMES_S)
    np.testing.assert_allclose(ramp, [0.5, 0.588, 0.8445, 1.5005])
    steady = SpeedRamp(0.5, 0.2, 0.0), ConstantSpeed(0.5, 0.2)
    np.testing.assert_array_equal(*(kinematics.angle_rad(0, TIMES_S) for kinematics in steady))
    sweeps = FrameSweeps(np.array([0.0, 10.0]), 2.0, np.array([0.1, 0.5]), np.array([0.3, 0.1]))
    np.testing.assert_allclose(sweeps.angle_rad(0, np.array([0.0, 1.0, 2.0, 3.0])), [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(sweeps.angle_rad(1, np.array([10.0, 12.0, 13.0])), [0.5, 0.1, -0.1])
    at_rest = FrameSweeps(np.zeros(1), 0.0, np.array([0.7]), np.array([0.9]))
    np.testing.assert_array_equal(at_rest.angle_rad(0, np.array([0.0, 5.0])), [0.7, 0.7])


def test_tables_are_linear_between_their_samples_and_never_continued() -> None:
    encoder = EncoderTable([0.0, 1.0, 3.0], [0.0, 0.2, 1.0], "scan.h5:/kinematics")
    poses = PoseTable([0.0, 1.0, 3.0], GEOMETRY.pose(np.array([0.0, 0.2, 1.0])), "scan.h5:/poses")
    found = encoder.angle_rad(0, np.array([0.0, 0.5, 1.0, 2.0, 3.0]))
    np.testing.assert_allclose(found, [0, 0.1, 0.2, 0.6, 1.0])
    for time_s in (-0.01, 3.01):
        with pytest.raises(InputError, match=r"scan.h5:/kinematics: found frame 5 needs"):
            encoder.angle_rad(5, np.array([1.0, time_s]))
        with pytest.raises(InputError, match=r"scan.h5:/poses: found frame 5 needs"):
            poses.pose(5, np.array([1.0, time_s]))


def test_rounding_of_stored_times_is_forgiven_up_to_a_slack() -> None:
    poses, asked_s = PoseTable([0.1, 3.3], GEOMETRY.pose(np.array([0.0, 1.0]))), np.array([0.1 - 1e-10, 3.3 + 1e-10])
    np.testing.assert_allclose(poses.pose(0, asked_s), poses.table, atol=RIGID_TOLERANCE_MM)
    for times_s, slack_s in [([0.0, 0.25, 0.5], 1e-9), ([0.0, 1.0, 1000.0], 1e-6)]:
        encoder, last_s = EncoderTable(times_s, [0.0, 0.1, 0.2]), times_s[-1]
        for share in (0.9, 1.0):
            asked_s = np.array([-share * slack_s, last_s + share * slack_s])
            np.testing.assert_array_equal(encoder.angle_rad(0, asked_s), [0.0, 0.2])
        for beyond_s in (-1.1 * slack_s, last_s + 1.1 * slack_s):
            with pytest.raises(InputError, match="encoder table"):
                encoder.angle_rad(0, np.array([beyond_s]))


@pytest.mark.parametrize(("step_deg", "tilts"), [(1.0, [0, 0, 0]), (60.0, [0, 0, 0]), (-20.0, [0.4, -0.7, 1.1])])
def test_poses_between_samples_stay_on_a_circular_orbit(step_deg, tilts) -> None:
    """Of a machine that stands any way. Linear interpolation of the twelve numbers would be 1 mm off at 5°."""
    machine = Rotation.from_euler("xyz", tilts).as_matrix()

    def orbit(time_s: np.ndarray) -> np.ndarray:
        return (GEOMETRY.pose(np.deg2rad(step_deg) * time_s).reshape(-1, 4, 3) @ machine.T).reshape(-1, 12)

    time_s, asked_s = np.arange(7.0), np.linspace(0, 6, 61)
    table, expected = PoseTable(time_s, orbit(time_s)), orbit(asked_s)
    np.testing.assert_allclose(table.pose(0, asked_s), expected, rtol=0, atol=RIGID_TOLERANCE_MM)
    naive = np.stack([np.interp(asked_s, time_s, column) for column in table.table.T], -1)
    assert np.abs(naive - expected).max() > 1e-2


def test_an_encoder_table_goes_on_at_the_speed_of_its_ends() -> None:
    table = EncoderTable(np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.1, 0.5]))
    longer, times_s = continued(CircularOrbit(GEOMETRY, table), 2.0), np.array([-2.0, 0.0, 0.5, 3.0, 5.0])
    np.testing.assert_allclose(longer.angle_rad(0, times_s), [-0.2, 0.0, 0.05, 0.5, 0.9])
    steady = CircularOrbit(GEOMETRY, ConstantSpeed(0.0, 1.0))
    assert continued(steady, 2.0) is steady
