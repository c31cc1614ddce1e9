"""θ(t) of every kind, and pose tables as a rigid body."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition import (
    CircularOrbit,
    ConeGeometry,
    ConstantSpeed,
    EncoderTable,
    FrameSweeps,
    PoseTable,
    SpeedRamp,
)
from phyradgs_cl.acquisition.trajectory import continued
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
    time_s = np.array([0.1, 3.3])
    encoder, poses = EncoderTable(time_s, [0.0, 1.0]), PoseTable(time_s, GEOMETRY.pose(np.array([0.0, 1.0])))
    asked_s = np.array([0.1 - 1e-10, 3.3 + 1e-10])
    np.testing.assert_allclose(encoder.angle_rad(0, asked_s), [0, 1])
    np.testing.assert_allclose(poses.pose(0, asked_s), poses.table, atol=RIGID_TOLERANCE_MM)
    for times_s, slack_s in [([0.0, 0.25, 0.5], 1e-9), ([0.0, 1.0, 1000.0], 1e-6)]:
        encoder, last_s = EncoderTable(times_s, [0.0, 0.1, 0.2]), times_s[-1]
        for share in (0.9, 1.0):
            asked_s = np.array([-share * slack_s, last_s + share * slack_s])
            np.testing.assert_array_equal(encoder.angle_rad(0, asked_s), [0.0, 0.2])
        for beyond_s in (-1.1 * slack_s, last_s + 1.1 * slack_s):
            with pytest.raises(InputError, match="encoder table"):
                encoder.angle_rad(0, np.array([beyond_s]))


@pytest.mark.parametrize("step_deg", [1.0, 5.0, 60.0, -20.0])
def test_poses_between_samples_stay_on_a_circular_orbit(step_deg) -> None:
    """The body is rigid: linear interpolation of the twelve numbers would be 1 mm off at 5°."""
    time_s = np.arange(7.0)
    table = PoseTable(time_s, GEOMETRY.pose(np.deg2rad(step_deg) * time_s))
    asked_s = np.linspace(0, 6, 61)
    expected = GEOMETRY.pose(np.deg2rad(step_deg) * asked_s)
    np.testing.assert_allclose(table.pose(0, asked_s), expected, rtol=0, atol=RIGID_TOLERANCE_MM)
    naive = np.stack([np.interp(asked_s, time_s, column) for column in table.table.T], -1)
    assert np.abs(naive - expected).max() > 1e-2


def test_interpolation_commutes_with_moving_the_whole_machine() -> None:
    """A tilted orbit of a tilted panel: rotate all poses, and the interpolated ones rotate along."""
    time_s = np.arange(5.0)
    circle = GEOMETRY.pose(0.3 * time_s)
    circle[:, 6:12] = circle[:, 6:12] + 0.01  # panel no longer parallel to the axis
    turn = Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix()

    def turned(poses):
        return (poses.reshape(-1, 4, 3) @ turn.T).reshape(-1, 12)

    asked_s = np.array([0.25, 1.5, 3.9])
    ours = PoseTable(time_s, turned(circle)).pose(0, asked_s)
    expected = turned(PoseTable(time_s, circle).pose(0, asked_s))
    np.testing.assert_allclose(ours, expected, atol=RIGID_TOLERANCE_MM)


def test_an_encoder_table_goes_on_at_the_speed_of_its_ends() -> None:
    table = EncoderTable(np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.1, 0.5]))
    longer = continued(CircularOrbit(GEOMETRY, table), 2.0)
    times_s = np.array([-2.0, 0.0, 0.5, 3.0, 5.0])
    np.testing.assert_allclose(longer.angle_rad(0, times_s), [-0.2, 0.0, 0.05, 0.5, 0.9])
    steady = CircularOrbit(GEOMETRY, ConstantSpeed(0.0, 1.0))
    assert continued(steady, 2.0) is steady
