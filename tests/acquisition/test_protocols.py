"""Protocols against the paper's numbers, and scans that check themselves."""

import dataclasses

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan, Shutter, make_protocol
from phyradgs_cl.acquisition.trajectory import CircularOrbit, EncoderTable, PoseTable
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

GEOMETRY = ConeGeometry(5.0, 7.0, (4, 4), (1.0, 1.0))
ANGLE_TOLERANCE_DEG = 1e-9


def angles_deg(protocol: Protocol, frame: int, after_s) -> np.ndarray:
    orbit = protocol.orbit(GEOMETRY)
    return np.rad2deg(orbit.angle_rad(frame, protocol.frame_start_s()[frame] + np.asarray(after_s)))


@pytest.mark.parametrize("name, views, arc_deg", [("rapid", 25, 14.4), ("standard", 50, 7.2)])
def test_fly_protocols_of_the_paper(name, views, arc_deg) -> None:
    protocol = make_protocol(name)
    assert protocol.is_fly and protocol.views == views
    for frame in (0, 1, views - 1):
        # exposure arc, then the readout continues it to T_exp + T_ro = 1.86 exposures
        expected = 360 / views * frame + np.array([0, arc_deg, 1.86 * arc_deg])
        np.testing.assert_allclose(angles_deg(protocol, frame, [0, 1, 1.86]), expected, atol=ANGLE_TOLERANCE_DEG)
    assert protocol.shutter().span_s == pytest.approx(1.86)
    assert name != "rapid" or 1.86 * arc_deg == pytest.approx(26.8, abs=0.02)  # table 2


@pytest.mark.parametrize("exposure_s", [1.0, 2.5])
def test_stop_and_shoot_stands_at_the_mid_window_angles_of_the_fly_scan(exposure_s) -> None:
    static, fly = (make_protocol(name, exposure_s=exposure_s) for name in ("static", "rapid"))
    for frame in (0, 5, 24):
        middle = angles_deg(fly, frame, [1.86 * exposure_s / 2])[0]
        stands = angles_deg(static, frame, [0, 0.4, 1.86])
        np.testing.assert_allclose(stands, [middle] * 3, atol=ANGLE_TOLERANCE_DEG)
    assert not static.is_fly
    protocol = Protocol(views=10, exposure_deg=0.0)
    np.testing.assert_allclose(angles_deg(protocol, 4, [0, 1, 2]), [144.0] * 3, atol=ANGLE_TOLERANCE_DEG)
    assert np.all(np.diff(protocol.frame_start_s()) > 0)


@pytest.mark.parametrize("exposure_s", [1.0, 2.5])
def test_times_grow_with_the_exposure(exposure_s) -> None:
    protocol = Protocol(4, 0.0, 0.5, exposure_s=exposure_s, pulse=(0.5, 0.25))
    shutter = protocol.shutter()
    assert (shutter.exposure_s, shutter.readout_s) == (exposure_s, 0.5 * exposure_s)
    assert shutter.pulse_s == (0.5 * exposure_s, 0.25 * exposure_s)
    np.testing.assert_allclose(protocol.frame_start_s(), 1.5 * exposure_s * np.arange(4), rtol=1e-12)
    turning = Protocol(4, 30.0, exposure_s=exposure_s)
    np.testing.assert_allclose(turning.frame_start_s(), 3 * exposure_s * np.arange(4), rtol=1e-12)


def test_the_gantry_wanders_in_straight_lines_between_one_knot_per_frame() -> None:
    protocol = Protocol(5, 20.0, exposure_s=2.0, start_deg=7.0)
    encoder = protocol.orbit(GEOMETRY, 0.3, np.random.default_rng(6)).kinematics
    knots = np.random.default_rng(6).normal(0, np.deg2rad(0.3), 6)
    end_s = protocol.frame_start_s()[-1] + protocol.shutter().span_s
    wander = encoder.angle_rad_table - np.deg2rad(7.0) - np.deg2rad(10.0) * encoder.time_s
    expected = np.interp(encoder.time_s, np.linspace(0, end_s, 6), knots)
    np.testing.assert_allclose(wander, expected, rtol=0, atol=1e-12)
    at_knots = np.interp(np.linspace(0, end_s, 6), encoder.time_s, wander)
    np.testing.assert_allclose(at_knots, knots, rtol=0, atol=1e-12)  # no corner is cut
    assert (encoder.time_s[0], encoder.time_s[-1]) == (0.0, end_s)
    for orbit, generator in ((protocol.orbit, None), (Protocol(exposure_deg=0.0).orbit, np.random.default_rng(0))):
        with pytest.raises(InputError, match="jitter"):
            orbit(GEOMETRY, 0.2, generator)


def test_timing_names_the_first_frame_that_a_table_misses() -> None:
    frames, rest = np.zeros((3, 4, 4)), (Protocol().shutter(), np.array([0.0, 10.0, 20.0]), Grid.cube(4, 2.0))
    for end_s, frame in ((20.0 + rest[0].span_s, None), (21.8, 2), (11.8, 1)):
        moving = Scan(frames, GEOMETRY, CircularOrbit(GEOMETRY, EncoderTable([0.0, end_s], [0.0, 1.0])), *rest)
        if frame is None:
            moving.check_timing()
        else:
            with pytest.raises(InputError, match=f"frame {frame} needs"):
                moving.check_timing()
    poses = PoseTable([0.0, 20.5], GEOMETRY.pose(np.array([0.0, 1.0])))
    stopped = Scan(frames, GEOMETRY, poses, *rest, is_fly=False)
    with pytest.raises(InputError, match="frame 2 needs"):
        stopped.check_timing()
    dataclasses.replace(stopped, shutter=Shutter(0.5, 0.5)).check_timing()
