"""Time cells that move, and what is made of tables: layers without two cells of a line, finer panels, how many segments."""

from dataclasses import replace

import numpy as np
import pytest
from tolerances import FLOAT64

from phyradgs_cl.acquisition import ConeGeometry, Shutter, pixel_centres
from phyradgs_cl.acquisition.cells import (
    exact_cells,
    micro_view_cells,
    per_line_cells,
    segments_for,
    static_cells,
)
from phyradgs_cl.acquisition.trajectory import CircularOrbit, ConstantSpeed, EncoderTable, SpeedRamp
from phyradgs_cl.errors import InputError

LINES = 10
GEOMETRY = ConeGeometry(50.0, 70.0, (LINES, 7), (0.6, 0.5), (1.0, -2.0))
START_S, SPEED_RAD_PER_S = 3.0, 0.25
ORBIT = CircularOrbit(GEOMETRY, ConstantSpeed(0.1, SPEED_RAD_PER_S))


def micro_views(strips: int, sub_intervals: int):
    return micro_view_cells(ORBIT, Shutter(0.8, 0.6), 0, 3.0, LINES, strips, sub_intervals)


def test_layers_hold_every_lines_weights_once_and_no_cell_needs_none() -> None:
    """Cells that only touch share a layer."""
    np.testing.assert_array_equal(micro_views(3, 1).layer_numbers, 0)
    assert sorted(micro_views(2, 3).layer_numbers) == [0, 0, 1, 1, 2, 2]
    for table in (micro_views(3, 2), exact_cells(ORBIT, Shutter(0.8, 0.6), 0, 3.0, LINES, 4)):
        numbers, weights = table.layer_numbers, table.layer_weights
        assert weights.shape == (numbers.max() + 1, LINES)
        np.testing.assert_allclose(weights.sum(0), table.line_weights(), rtol=0, atol=FLOAT64)
        for line in range(LINES):
            serving = [c for c in range(table.count) if table.line_start[c] <= line < table.line_stop[c]]
            assert len({int(numbers[c]) for c in serving}) == len(serving)
            for cell in serving:
                share = 1.0 if table.line_times is None else table.line_times[cell, 2, line]
                assert weights[numbers[cell], line] == table.weight[cell] * share


def test_a_line_s_pose_is_that_of_the_middle_of_its_exposure() -> None:
    where = (ORBIT, Shutter(0.8, 0.6), 1, 3.0, LINES)
    middles = per_line_cells(*where, 1).pose
    np.testing.assert_array_equal(per_line_cells(*where, 1).line_poses(), middles)
    np.testing.assert_allclose(per_line_cells(*where, 5).line_poses(), middles, rtol=0, atol=1e-12)
    strips = micro_view_cells(*where, 2, 3)
    expected = np.repeat(strips.pose[[1, 4]], LINES // 2, axis=0)
    np.testing.assert_array_equal(strips.line_poses(), expected)
    uneven = replace(micro_view_cells(*where, 1, 2), weight=np.array([0.4, 0.6]))
    np.testing.assert_array_equal(uneven.line_poses(), np.tile(uneven.pose[1], (LINES, 1)))
    assert static_cells(*where).line_poses().shape == (1, 12)
    with pytest.raises(InputError, match="a line without a time cell"):
        replace(strips, line_stop=strips.line_start + 1).line_poses()


def test_cells_that_serve_a_line() -> None:
    """Sorted by first line, but of any length, with gaps and with lines that nothing serves."""
    ranges = np.array([[1, 2], [1, 9], [2, 3], [4, 6], [10, 12], [10, 11]])
    one = static_cells(ORBIT, Shutter(0.8, 0.6), 0, 3.0, 14)
    served = replace(one, line_start=ranges[:, 0], line_stop=ranges[:, 1], weight=np.ones(6)).line_cells()
    for line, (first, stop) in enumerate(served):
        inside = np.flatnonzero((ranges[:, 0] <= line) & (line < ranges[:, 1]))
        assert all(first <= cell < stop for cell in inside)
    assert served[0, 0] >= served[0, 1] and served[13, 0] >= served[13, 1]


@pytest.mark.parametrize("factor", [2, 3])
def test_finer_pixels_lie_inside_of_those_they_were_cut_from(factor) -> None:
    table = micro_views(2, 2)
    finer = table.finer(factor, factor)
    assert finer.lines == factor * LINES
    np.testing.assert_array_equal(finer.line_stop, factor * table.line_stop)
    np.testing.assert_array_equal(finer.line_start, factor * table.line_start)
    coarse, fine = pixel_centres(table.pose, (LINES, 7)), pixel_centres(finer.pose, (factor * LINES, factor * 7))
    means = fine.reshape(table.count, LINES, factor, 7, factor, 3).mean(axis=(2, 4))
    np.testing.assert_allclose(means, coarse, rtol=0, atol=FLOAT64)
    np.testing.assert_array_equal(finer.pose[:, :3], table.pose[:, :3])
    own = GEOMETRY.finer(factor)
    assert own.detector_shape == (factor * LINES, factor * 7)
    angle = 0.1 + 0.25 * table.time_s[0]
    np.testing.assert_allclose(own.pose(angle), finer.pose[0], rtol=0, atol=FLOAT64)


@pytest.mark.parametrize(("reach", "served_by"), [(0.05, 1), (0.15, 2)])
@pytest.mark.parametrize("late", [False, True])
def test_a_line_stays_in_a_segment_that_it_overhangs_by_less_than_a_tenth(reach, served_by, late) -> None:
    """Two segments of a second; the first line is exposed from 0 to 1 + reach, or the last from 1 − reach to 2."""
    shutter = Shutter(1.0 + reach, 1.0 - reach)
    table = exact_cells(ORBIT, shutter, 0, 3.0, LINES, 2)
    share = table.line_times[:, 2, -1 if late else 0]
    assert np.count_nonzero(share) == served_by
    expected = [1.0] if served_by == 1 else [reach / (1 + reach), 1 / (1 + reach)]
    np.testing.assert_allclose(np.sort(share[share > 0]), expected, rtol=0, atol=FLOAT64)


def in_plane(pose: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """The panel turned about its normal."""
    u, v = pose[:, 6:9] / 0.5, pose[:, 9:12] / 0.6
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.concatenate([pose[:, :6], 0.5 * (cos * u + sin * v), 0.6 * (cos * v - sin * u)], 1)


def tipped(pose: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """The panel turned about its rows."""
    v = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    return np.concatenate([pose[:, :9], 0.6 * v], 1)


def source_alone(pose: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return np.concatenate([GEOMETRY.pose(0.1 + 0.75 + angle)[:, :3], pose[:, 3:]], 1)


@pytest.mark.parametrize("steps", [in_plane, tipped, source_alone])
def test_a_panel_that_turns_about_itself_needs_segments_too(steps) -> None:
    """By 0.25 rad/s, as the orbit, or the source alone. The number follows from the turn, 0.35 rad, and the bound."""

    class Turning:
        def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
            pose = np.tile(GEOMETRY.pose(0.0), (np.size(time_s), 1))
            return steps(pose, 0.25 * (np.asarray(time_s) - 3.0))

    where = (Shutter(0.8, 0.6), 0, 3.0, 0.001)
    count = np.ceil(0.35 * np.sqrt(0.32 / 0.001))
    assert segments_for(Turning(), *where) == segments_for(ORBIT, *where) == count


SHUTTERS = {
    "rolling": Shutter(0.8, 0.6), "backwards": Shutter(0.8, 0.6, "rows", -1), "slow readout": Shutter(0.2, 1.6),
    "global": Shutter(0.8, 0.0), "a moment": Shutter(0.0, 0.6), "pulsed": Shutter(0.8, 0.6, pulse_s=(0.5, 0.4)),
    "pulse that misses lines": Shutter(0.2, 0.6, pulse_s=(0.3, 0.1)),
}  # fmt: skip


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
    table, length_s = exact_cells(ORBIT, Shutter(0.8, 0.6), 0, START_S, LINES, 4), 1.4 / 4
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
    ramp, fastest_rad = CircularOrbit(GEOMETRY, SpeedRamp(0.0, 0.0, 3.0)), 32 * 1.5 * (1 - (31 / 32) ** 2)
    assert segments_for(ramp, Shutter(0.4, 0.6), 0, 0.0, 0.0005) == 75
    assert 74 < fastest_rad * np.sqrt(0.32 / 0.0005) < 75
