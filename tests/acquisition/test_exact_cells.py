"""Time cells with motion: segments of a frame, when every line integrates in them, and how many there are."""

import numpy as np
import pytest
from tolerances import FLOAT64

from phyradgs_cl.acquisition import (
    CircularOrbit,
    ConeGeometry,
    ConstantSpeed,
    EncoderTable,
    Shutter,
    SpeedRamp,
)
from phyradgs_cl.acquisition.cells import exact_cells, segments_for, static_cells

LINES = 9
GEOMETRY = ConeGeometry(50.0, 70.0, (LINES, 10), (0.6, 0.5))
START_S = 3.0
SPEED_RAD_PER_S = 0.25
ORBIT = CircularOrbit(GEOMETRY, ConstantSpeed(0.1, SPEED_RAD_PER_S))
SHUTTERS = {
    "rolling": Shutter(0.8, 0.6), "backwards": Shutter(0.8, 0.6, "rows", -1),
    "slow readout": Shutter(0.2, 1.6), "global": Shutter(0.8, 0.0), "a moment": Shutter(0.0, 0.6),
    "pulsed": Shutter(0.8, 0.6, pulse_s=(0.5, 0.4)),
    "pulse that misses lines": Shutter(0.2, 0.6, pulse_s=(0.3, 0.1)),
}


@pytest.mark.parametrize("shutter", SHUTTERS.values(), ids=SHUTTERS)
@pytest.mark.parametrize("segments", [1, 2, 3, 8, 40])
def test_segments_hold_every_window_once(shutter, segments) -> None:
    table = exact_cells(ORBIT, shutter, 0, START_S, LINES, segments)
    np.testing.assert_allclose(table.line_weights(), 1.0, rtol=0, atol=FLOAT64)
    first_s, last_s = shutter.lit_span_s
    length_s = (last_s - first_s) / segments
    middle, half, share = np.moveaxis(table.line_times, 1, 0)
    begins_s = table.time_s[:, None] - START_S + (middle - half) * length_s
    ends_s = table.time_s[:, None] - START_S + (middle + half) * length_s
    for line, (opens_s, closes_s) in enumerate(shutter.line_windows_s(LINES)):
        own = share[:, line] > 0
        order = np.argsort(begins_s[own, line])
        begins, ends = begins_s[own, line][order], ends_s[own, line][order]
        np.testing.assert_allclose([begins[0], ends[-1]], [opens_s, closes_s], rtol=0, atol=FLOAT64)
        np.testing.assert_allclose(begins[1:], ends[:-1], rtol=0, atol=FLOAT64)
    assert np.all(np.abs(middle) + half <= 0.75 + FLOAT64)  # what boxes of cl/splat_prepare.cl allow for
    for cell in range(table.count):
        served = np.flatnonzero(share[cell] > 0)
        np.testing.assert_array_equal(served, np.arange(table.line_start[cell], table.line_stop[cell]))
    assert np.all(np.diff(table.line_start) >= 0)


def test_poses_are_those_of_the_middle_and_both_ends() -> None:
    table = exact_cells(ORBIT, Shutter(0.8, 0.6), 0, START_S, LINES, 4)
    length_s = 1.4 / 4
    assert table.layer_numbers.max() > 0  # segments begin at different lines and still meet in one
    assert exact_cells(ORBIT, Shutter(0.8, 0.6), 0, START_S, LINES, 1).layer_numbers.max() == 0
    np.testing.assert_allclose(table.pose, ORBIT.pose(0, table.time_s), rtol=0, atol=FLOAT64)
    for end, sign in ((0, -1), (1, 1)):
        expected = ORBIT.pose(0, table.time_s + sign * length_s / 2)
        np.testing.assert_allclose(table.end_poses[:, end], expected, rtol=0, atol=FLOAT64)


def test_what_does_not_move_is_one_static_cell() -> None:
    at_rest = CircularOrbit(GEOMETRY, ConstantSpeed(0.1, 0.0))
    for orbit, shutter in ((at_rest, Shutter(0.8, 0.6)), (ORBIT, Shutter(0.0, 0.0))):
        table = exact_cells(orbit, shutter, 0, START_S, LINES, 5)
        expected = static_cells(orbit, shutter, 0, START_S, LINES)
        assert table.end_poses is None and table.count == 1 and table.layer_numbers.max() == 0
        np.testing.assert_array_equal(table.pose, expected.pose)


def test_segments_follow_from_bound_turn_and_contrast() -> None:
    where = (Shutter(0.8, 0.6), 0, START_S)
    counts = [segments_for(ORBIT, *where, bound) for bound in (1.0, 0.02, 0.005, 0.00125)]
    assert counts[0] == 1 and counts == sorted(counts) and counts[3] == pytest.approx(2 * counts[2], abs=1)
    faster = CircularOrbit(GEOMETRY, ConstantSpeed(0.1, 3 * SPEED_RAD_PER_S))
    assert segments_for(faster, *where, 0.005) == pytest.approx(3 * counts[2], abs=2)
    assert segments_for(CircularOrbit(GEOMETRY, ConstantSpeed(0.1, 0.0)), *where, 0.005) == 1
    assert segments_for(ORBIT, *where, 1e-9) == 1000  # there are never more
    where = (ORBIT, Shutter(0.8, 0.6), 0, START_S, 0.0005)
    counts = [segments_for(*where, peak) for peak in (0.0, 4.0, 8.0, 16.0)]
    assert counts[0] == counts[1] < counts[2] < counts[3] <= 2 * counts[0]


def test_the_fastest_of_32_parts_of_a_frame_counts() -> None:
    times_s = np.array([0.0, START_S + 0.7, START_S + 1.4, 10.0])
    angles_rad = np.array([0.0, 0.0, 0.35, 0.35])  # at rest, then twice the mean speed, then at rest
    jerky = CircularOrbit(GEOMETRY, EncoderTable(times_s, angles_rad))
    steady = CircularOrbit(GEOMETRY, ConstantSpeed(0.0, 0.5))
    where = (Shutter(0.8, 0.6), 0, START_S, 0.002)
    assert segments_for(jerky, *where) == segments_for(steady, *where) > 1
    ramp = CircularOrbit(GEOMETRY, SpeedRamp(0.0, 0.0, 3.0))
    fastest_rad = 32 * 1.5 * (1 - (31 / 32) ** 2)
    assert segments_for(ramp, Shutter(0.4, 0.6), 0, 0.0, 0.0005) == 75
    assert 74 < fastest_rad * np.sqrt(0.32 / 0.0005) < 75
