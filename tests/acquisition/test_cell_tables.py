"""What is made of tables of time cells: layers without two cells of a line, finer panels, segments that lines overhang."""

from dataclasses import replace

import numpy as np
import pytest
from tolerances import FLOAT64

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter, pixel_centres
from phyradgs_cl.acquisition.cells import (
    exact_cells,
    micro_view_cells,
    per_line_cells,
    segments_for,
    static_cells,
)
from phyradgs_cl.errors import InputError

LINES = 10
GEOMETRY = ConeGeometry(50.0, 70.0, (LINES, 7), (0.6, 0.5), (1.0, -2.0))
ORBIT = CircularOrbit(GEOMETRY, ConstantSpeed(0.1, 0.25))


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
    none = np.zeros(0, np.int32)
    one = static_cells(ORBIT, Shutter(0.8, 0.6), 0, 3.0, LINES)
    empty = replace(one, line_start=none, line_stop=none, weight=np.zeros(0))
    assert empty.layer_weights.shape == (0, LINES)


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
    coarse = pixel_centres(table.pose, (LINES, 7))
    fine = pixel_centres(finer.pose, (factor * LINES, factor * 7))
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


def in_a_tilted_plane(pose: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rows in the plane of the orbit at first, columns far from the axis of rotation."""
    tilted = pose.copy()
    tilted[:, 9:12] = 0.6 * np.array([np.sin(0.8), 0.0, np.cos(0.8)])
    return in_plane(tilted, angle)


def source_alone(pose: np.ndarray, angle: np.ndarray) -> np.ndarray:
    return np.concatenate([GEOMETRY.pose(0.1 + 0.75 + angle)[:, :3], pose[:, 3:]], 1)


@pytest.mark.parametrize("steps", [in_plane, tipped, in_a_tilted_plane, source_alone])
def test_a_panel_that_turns_about_itself_needs_segments_too(steps) -> None:
    """By 0.25 rad/s, as the orbit, or the source alone. The number follows from the turn, 0.35 rad, and the bound."""

    class Turning:
        def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
            pose = np.tile(GEOMETRY.pose(0.0), (np.size(time_s), 1))
            return steps(pose, 0.25 * (np.asarray(time_s) - 3.0))

    where = (Shutter(0.8, 0.6), 0, 3.0, 0.001)
    count = np.ceil(0.35 * np.sqrt(0.32 / 0.001))
    assert segments_for(Turning(), *where) == segments_for(ORBIT, *where) == count
