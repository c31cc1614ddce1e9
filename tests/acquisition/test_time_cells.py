"""Time cells of every motion model: weights, times (Eq. 2 of the paper), lines and poses; what of them a pulse lights."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan, Shutter
from phyradgs_cl.acquisition.cells import exact_cells, micro_view_cells, per_line_cells, segments_for
from phyradgs_cl.acquisition.motion import (
    LINE_POSES,
    MODELS,
    MOTIONS,
    RAYS,
    SPLATS,
    Centres,
    Exact,
    LineMiddles,
    MicroViews,
    OwnTimes,
    PerRow,
    Static,
    StaticStart,
    check_own_motion,
    motion_facts,
    motion_from_facts,
    motion_of,
    motions_for,
    rim_travel_voxels,
)
from phyradgs_cl.acquisition.trajectory import CircularOrbit, ConstantSpeed, PoseTable
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

SHAPE = (7, 10)
GEOMETRY = ConeGeometry(50.0, 70.0, SHAPE, (0.6, 0.5))
SPEED_RAD_PER_S = 0.25
ORBIT = CircularOrbit(GEOMETRY, ConstantSpeed(0.1, SPEED_RAD_PER_S))
START_S = 3.0
TIME_TOLERANCE_S = 1e-12
DARK_FROM = Shutter(0.8, 1.2, pulse_s=(0.1, 0.9))  # the last lines open after 1.0 s


@pytest.mark.parametrize("axis", ["rows", "columns"])
@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("pulse_s", [None, (0.25, 0.7)])
def test_cells_have_the_times_of_eq_2_on_every_line(axis, direction, pulse_s) -> None:
    """Micro-views those of its strip, cells of one line (here: no strips) those of its own exposure, as far as it is lit."""
    shutter = Shutter(0.8, 0.3, axis, direction, pulse_s)
    lines = shutter.lines(SHAPE)
    where = (ORBIT, shutter, 0, START_S, lines)
    for strips, times in [*product([1, 2, 3, 7, 8, 10, 25], [1, 3, 5]), (None, 1), (None, 4)]:
        cells = per_line_cells(*where, times) if strips is None else micro_view_cells(*where, strips, times)
        assert cells.axis == axis and cells.lines == lines
        assert cells.count == min(strips or lines, lines) * times  # none for strips without a line
        assert np.all(np.diff(cells.line_start) >= 0)  # cells of a line are neighbours
        assert strips or np.all(cells.line_stop - cells.line_start == 1)
        np.testing.assert_allclose(cells.line_weights(), 1, rtol=1e-12)
        for line in range(lines):
            order = line if direction > 0 else lines - 1 - line
            opens = (order * strips // lines + 0.5) / strips if strips else order / (lines - 1)
            first_s, last_s = (0.3 * opens + np.array([0.0, 0.8])).clip(*((0.25, 0.95) if pulse_s else (0.0, 2.0)))
            expected_s = START_S + first_s + (np.arange(times) + 0.5) / times * (last_s - first_s)
            serving = (cells.line_start <= line) & (line < cells.line_stop)
            np.testing.assert_allclose(np.sort(cells.time_s[serving]), expected_s, atol=TIME_TOLERANCE_S)
            np.testing.assert_allclose(cells.weight[serving], 1 / times)


COLUMNS = Shutter(0.8, 0.3, "columns")


def scan(is_fly: bool, shutter: Shutter = COLUMNS, **changes: object) -> Scan:
    frames, start_s = np.zeros((2, *SHAPE), np.float32), np.array([0.0, START_S])
    return Scan(frames, GEOMETRY, ORBIT, shutter, start_s, Grid.cube(4, 2.0), is_fly=is_fly, **changes)


def test_motion_models_of_fly_and_stop_and_shoot_scans() -> None:
    counts = {
        Static(): 1, StaticStart(): 1, MicroViews(4, 3): 12, Centres(4, 3): 12, PerRow(sub_intervals=3): 5,
        OwnTimes(sub_intervals=3): 30, Exact(segments=5): 5, LineMiddles(): 10,
    }
    assert (MicroViews(), PerRow(), Exact()) == (MicroViews(8, 5), PerRow(0), Exact(0, 0.005))
    for motion, count in counts.items():
        moving = motion.cells(scan(True), 1)
        assert moving.count == count and motion.cells(scan(False), 1).count == 1
        assert moving.lines == 10 and moving.axis == "columns"
        first_s, last_s = moving.time_s.min(), moving.time_s.max()
        assert START_S <= first_s <= last_s <= START_S + 1.1
    with pytest.raises(InputError, match="micro-views"):
        motion_of("micro-view")
    assert [motion_of(name).name for name in MOTIONS] == list(MOTIONS) and motion_of(model := MicroViews(3)) is model


@pytest.mark.parametrize(
    ("size", "exposure_deg", "count"),
    [(64, 14.4, 6), (128, 14.4, 6), (256, 14.4, 9), (64, 7.2, 6), (64, 4.8, 6), (64, 1.0, 2), (64, 0.4, 1), (512, 0.16, 3)],
)
def test_the_rim_decides_on_the_times_of_an_exposure(size, exposure_deg, count) -> None:
    speed = ConstantSpeed(0.3, np.deg2rad(exposure_deg) / 0.8)
    fly = replace(scan(True), trajectory=CircularOrbit(GEOMETRY, speed), grid=Grid.cube(size, 2.0))
    assert rim_travel_voxels(fly) == pytest.approx(size * np.sin(np.deg2rad(exposure_deg) / 2), rel=1e-9)
    assert PerRow().of(fly) == PerRow(count) and PerRow(7).of(fly) == PerRow(7)
    assert PerRow().cells(fly, 1).count == PerRow(count).cells(fly, 1).count
    assert PerRow().of(replace(fly, is_fly=False)) == PerRow(1)
    quick_mm_per_s = 2 * 2.0 / size / fly.shutter.exposure_s  # two voxels in an exposure: three times
    assert PerRow().of(fly, quick_mm_per_s) == PerRow(max(count, 3)) and PerRow(7).of(fly, quick_mm_per_s) == PerRow(7)
    flat = replace(fly, grid=replace(fly.grid, voxel_size_mm=(0.1 / size, *fly.grid.voxel_size_mm[1:])))
    assert PerRow().of(flat) == PerRow(count)  # the rim moves within slices


def test_the_rim_moves_where_the_panel_slides() -> None:
    poses = np.tile(ORBIT.pose(0, np.array([0.0])), (2, 1))
    poses[1, [1, 4]] += 0.6  # source and panel along y
    sliding = PoseTable(np.array([START_S, START_S + 1.6]), poses)
    fly = replace(scan(True), trajectory=sliding, frame_start_s=START_S + np.array([0.0, 0.8]), shutter=Shutter(0.8))
    assert rim_travel_voxels(fly) == pytest.approx(0.3 / min(fly.grid.voxel_size_mm[1:]))


def test_a_model_states_the_operators_that_take_it() -> None:
    still = [Static(), StaticStart(), MicroViews(), PerRow(), OwnTimes()]
    assert list(motions_for(RAYS)) == still and list(motions_for(LINE_POSES)) == [Static(), StaticStart(), LineMiddles()]
    assert list(motions_for(SPLATS)) == [Static(), StaticStart(), MicroViews(), Centres(), Exact()]
    for motion in MODELS:  # rays and lines need cells that stand still
        cells = motion().cells(scan(True), 1)
        if motion.operators == (SPLATS,):
            with pytest.raises(InputError, match="--motion"):
                cells.still()
        else:
            assert cells.still() is cells


def test_facts_of_a_model_are_the_model() -> None:
    for model in MODELS:
        assert motion_from_facts(motion_facts(model())) == model()
    odd = MicroViews(3, 2)
    assert motion_facts(odd) == {"name": "micro-views", "strips": 3, "sub_intervals": 2}
    assert motion_from_facts(motion_facts(odd)) == odd and motion_from_facts({"name": "Own"}) is None
    assert motion_facts(Own(None)) == {"name": "Own"}


class Own:
    """Cells that somebody else has made."""

    def __init__(self, made: object) -> None:
        self.made = made

    def cells(self, scan: Scan, frame: int) -> object:
        return self.made if frame == 0 else None


def test_cells_of_ones_own_have_to_fit_the_scan() -> None:
    fly = scan(True)
    good = MicroViews(4, 3).cells(fly, 0)
    for fine in (None, Static(), Own(good), Own(replace(good, weight=good.weight * 1.0009))):
        check_own_motion(fine, fly)
    for made, told in (
        (None, "a NoneType from cells"), (replace(good, lines=9), "cells for 9 columns"),
        (replace(good, axis="rows"), "cells for 10 rows"), (replace(good, pose=good.pose[:, :9]), "pose"),
        (replace(good, time_s=good.time_s[:3]), "time_s"), (replace(good, weight=0.5 * good.weight), "sum to 0.5"),
        (replace(good, weight=1.0015 * good.weight), "sum to 1.0015"),
        (replace(good, line_stop=good.line_stop + (np.arange(12) < 3)), "sum to 2"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"motion Own.*{told}"):
            check_own_motion(Own(made), fly)


def test_without_a_number_segments_follow_from_the_time_error() -> None:
    fly = scan(True)
    for peak in (0.0, 40.0):
        segments = segments_for(ORBIT, fly.shutter, 1, START_S, 0.001, peak)
        expected = exact_cells(ORBIT, fly.shutter, 1, START_S, 10, segments)
        found = Exact(time_error=0.001).cells(fly, 1, peak)
        np.testing.assert_array_equal(found.line_times, expected.line_times)
        np.testing.assert_array_equal(found.pose, expected.pose)


def test_a_window_is_cut_by_the_pulse_or_missed() -> None:
    shutter = Shutter(0.8, 0.6, pulse_s=(0.3, 0.7))
    expected = [[max(0.1 * r, 0.3), min(0.1 * r + 0.8, 1.0)] for r in range(7)]
    np.testing.assert_allclose(shutter.line_windows_s(7), expected, atol=TIME_TOLERANCE_S)
    assert shutter.lit_span_s == pytest.approx((0.3, 1.0)) and shutter.middle_s == pytest.approx(0.65)
    seen = np.diff(expected)[:, 0]
    np.testing.assert_allclose(shutter.lit_share(7), seen / seen.max(), rtol=1e-12)
    windows_s, share = DARK_FROM.line_windows_s(7), DARK_FROM.lit_share(7)
    np.testing.assert_array_equal(share > 0, [True] * 5 + [False] * 2)  # line 5 opens at 1.0 s
    np.testing.assert_array_equal(windows_s[5:], 1.0)
    assert Shutter(1.0, 0.5).delay_s(1) == Shutter(1.0, 0.5, direction=-1).delay_s(1) == 0  # a panel of one line


def test_a_billionth_of_a_window_is_rounding() -> None:
    """The last line opens when the pulse has all but ended."""
    for exposure_s, (seen, share) in product((1.0, 4.0), [(0.5e-9, 0.0), (1.5e-9, 1.5e-9)]):
        lit = Shutter(exposure_s, exposure_s, pulse_s=(0.0, exposure_s * (1 + seen))).lit_share(3)
        np.testing.assert_allclose(lit, [1.0, 0.5, share], rtol=1e-6)


@pytest.mark.parametrize("direction", [1, -1])
def test_every_time_lies_in_the_pulse_and_weights_stay_whole(direction) -> None:
    pulsed = scan(True, replace(DARK_FROM, direction=direction))
    tables = [motion.cells(pulsed, 1) for motion in (MicroViews(4, 3), OwnTimes(3), Static(), StaticStart())]
    for cells in tables:
        np.testing.assert_allclose(cells.line_weights(), 1, rtol=1e-12)
        assert cells.time_s.min() >= START_S + 0.1 - TIME_TOLERANCE_S
        assert cells.time_s.max() <= START_S + 1.0 + TIME_TOLERANCE_S
    middle, start = tables[2:]  # of the light
    assert (middle.time_s[0], start.time_s[0]) == pytest.approx((START_S + 0.55, START_S + 0.1))


def test_dark_lines_join_the_mask_of_a_scan() -> None:
    assert scan(True, Shutter(0.8, 1.2)).pixel_mask is None
    expected = np.zeros(SHAPE, bool)
    expected[5:] = True
    np.testing.assert_array_equal(scan(True, DARK_FROM).pixel_mask, expected)
    own = np.zeros((2, *SHAPE), np.int32)
    own[1, 2, 3] = 64
    found = scan(True, DARK_FROM, pixel_mask=own).pixel_mask
    np.testing.assert_array_equal(found, (own != 0) | expected)
    by_column = scan(True, Shutter(0.8, 1.8, "columns", -1, (0.0, 0.5))).pixel_mask
    assert by_column[:, :7].all() and not by_column[:, 7:].any()  # column 6 opens at 0.6 s


@pytest.mark.parametrize("is_fly", [True, False])
def test_a_pulsed_scan_knows_when_it_needs_a_pose(is_fly) -> None:
    pulsed = scan(is_fly, DARK_FROM)
    pulsed.check_timing()
    assert Static().cells(pulsed, 1).time_s[0] == pytest.approx(START_S + 0.55)
    # a protocol pulses in shares of the exposure
    protocol = Protocol(views=4, exposure_deg=10.0, readout_ratio=0.5, pulse=(0.5, 0.4), is_fly=is_fly)
    angle = protocol.orbit(GEOMETRY).angle_rad(1, protocol.frame_start_s()[1] + np.array([0.7]))
    assert np.rad2deg(angle[0]) == pytest.approx(97.0)  # moving there, or standing there


def test_pulses_that_no_frame_sees_are_refused() -> None:
    for pulse in [
        (0.0, 0.0), (0.2, 0.0), (0.0, -1.0), (0.2, -0.1), (1.5, 1.0), (2.0, 1.0), (-0.5, 0.5), (-3.0, 1.0),
        (np.nan, 1.0), (0.0, np.inf), "0.2,0.5", 0.5, (0.1, 0.2, 0.3),
    ]:  # fmt: skip
        with pytest.raises(InputError, match="pulse"):
            Protocol(readout_ratio=0.5, pulse=pulse)
        with pytest.raises(InputError, match="pulse_s"):
            Shutter(1.0, 0.5, pulse_s=pulse)
    for pulse in ((-0.5, 0.6), (1.4, 5.0)):  # that meet the window are kept
        assert Protocol(readout_ratio=0.5, pulse=pulse).shutter().pulse_s == pulse
    with pytest.raises(InputError, match="no line is open"):
        Shutter(0.1, 10.0, pulse_s=(0.5, 0.2)).lit_share(3)
