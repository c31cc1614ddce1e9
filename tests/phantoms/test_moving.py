"""Bodies that move: RTK's numbers, line integrals at any time, and the phantom as it is at a time."""

import numpy as np
import pytest
from refusals import assert_refused
from tolerances import FLOAT64

from phyradgs_cl.phantoms import Cylinder, Ellipsoid, MovingBody, MovingPhantom, moving_sphere

HALF_MM = 64.0  # of RTK's box


def test_the_sphere_is_where_rtk_has_it_in_each_frame() -> None:
    phantom = moving_sphere(HALF_MM)
    ball, hole = phantom.at(0.0).ellipsoids
    assert ball.semi_axes_mm == (60.0,) * 3 and hole.semi_axes_mm == (8.0,) * 3
    assert hole.attenuation_per_mm == -0.5 * ball.attenuation_per_mm
    for frame in range(20):
        place_mm = 4.0 * (abs((4 + frame) % 8 - 4) - 2)
        assert phantom.at(float(frame)).ellipsoids[1].centre_mm == pytest.approx((0.0, place_mm, 0.0), abs=FLOAT64)


def test_line_integrals_follow_the_bodies() -> None:
    wire = Cylinder(((0.0, 0.0, -0.4), (0.0, 0.0, 0.4)), 0.1, 2.0)
    egg = Ellipsoid((0.1, 0.2, 0.0), (0.3, 0.2, 0.2), 1.0)
    moving = (MovingBody(wire, (0.2, 0.1, 0.3), 3.0), MovingBody(egg, (-0.3, 0.0, 0.1), 3.0))
    phantom = MovingPhantom((Ellipsoid((0.0, 0.0, 0.0), (0.8,) * 3, 0.2),), moving, "two of them")
    rng, times_s = np.random.default_rng(1), np.array([0.0, 0.4, 1.5, 2.9, 7.3])
    source, target = rng.normal(size=(5, 1, 1, 3)) * 3, rng.normal(size=(5, 4, 6, 3)) * 0.5
    integrals = phantom.line_integrals(source, target, times_s)
    for k, time_s in enumerate(times_s):
        expected = phantom.at(time_s).line_integrals(source[k], target[k])
        np.testing.assert_allclose(integrals[k], expected, atol=FLOAT64)
    assert np.ptp(integrals) > 0.1
    assert phantom.reach_mm >= max(phantom.at(t).reach_mm for t in np.linspace(0, 3, 31)) - FLOAT64


def test_wrong_bodies_are_refused() -> None:
    ball = Ellipsoid((0.0, 0.0, 0.0), (1.0,) * 3, 1.0)
    one, other = MovingBody(ball, (1.0, 0.0, 0.0), 2.0), MovingBody(ball, (1.0, 0.0, 0.0), 3.0)
    assert_refused({
        "period_s": lambda: MovingBody(ball, (1.0, 0.0, 0.0), 0.0), "swing_mm": lambda: MovingBody(ball, (1.0, 0.0), 1.0),
        "periods": lambda: MovingPhantom((ball,), (one, other), "x"),
        "moving bodies": lambda: MovingPhantom((ball,), (), "x"),
    })  # fmt: skip
