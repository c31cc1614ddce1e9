"""Times at which lines open, strips, and pulses: a line sees the part of its window in the pulse."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, Protocol, Scan, Shutter, Static
from phyradgs_cl.acquisition.cells import micro_view_cells, per_line_cells, single_cell, static_cells
from phyradgs_cl.acquisition.trajectory import CircularOrbit, ConstantSpeed
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

SHAPE = (7, 10)
GEOMETRY = ConeGeometry(50.0, 70.0, SHAPE, (0.6, 0.5))
ORBIT = CircularOrbit(GEOMETRY, ConstantSpeed(0.1, 0.25))
START_S = 3.0
TIME_TOLERANCE_S = 1e-12
DARK_FROM = Shutter(0.8, 1.2, pulse_s=(0.1, 0.9))  # the last lines open after 1.0 s


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
    where = (ORBIT, replace(DARK_FROM, direction=direction), 0, START_S, 7)
    tables = (
        micro_view_cells(*where, 4, 3), per_line_cells(*where, 3), static_cells(*where),
        single_cell(*where[:3], START_S + where[1].lit_span_s[0], 7),
    )
    for cells in tables:
        np.testing.assert_allclose(cells.line_weights(), 1, rtol=1e-12)
        assert cells.time_s.min() >= START_S + 0.1 - TIME_TOLERANCE_S
        assert cells.time_s.max() <= START_S + 1.0 + TIME_TOLERANCE_S
    middle, start = tables[2:]  # of the light
    assert (middle.time_s[0], start.time_s[0]) == pytest.approx((START_S + 0.55, START_S + 0.1))


def test_sub_intervals_share_the_lit_part_of_a_strips_window() -> None:
    cells = micro_view_cells(ORBIT, Shutter(0.8, 0.6, pulse_s=(0.3, 0.7)), 0, 0.0, 7, 2, 4)
    for first_line, opens_s in ((0, 0.15), (4, 0.45)):
        first_s, last_s = max(opens_s, 0.3), min(opens_s + 0.8, 1.0)
        expected = first_s + (np.arange(4) + 0.5) / 4 * (last_s - first_s)
        found = cells.time_s[(cells.line_start <= first_line) & (first_line < cells.line_stop)]
        np.testing.assert_allclose(found, expected, atol=TIME_TOLERANCE_S)


def scan(shutter: Shutter, **changes: object) -> Scan:
    frames, start_s = np.zeros((2, *SHAPE), np.float32), np.array([0.0, START_S])
    return Scan(frames, GEOMETRY, ORBIT, shutter, start_s, Grid.cube(4, 2.0), **changes)


def test_dark_lines_join_the_mask_of_a_scan() -> None:
    assert scan(Shutter(0.8, 1.2)).pixel_mask is None
    expected = np.zeros(SHAPE, bool)
    expected[5:] = True
    np.testing.assert_array_equal(scan(DARK_FROM).pixel_mask, expected)
    own = np.zeros((2, *SHAPE), np.int32)
    own[1, 2, 3] = 64
    found = scan(DARK_FROM, pixel_mask=own).pixel_mask
    np.testing.assert_array_equal(found, (own != 0) | expected)
    by_column = scan(Shutter(0.8, 1.8, "columns", -1, (0.0, 0.5))).pixel_mask
    assert by_column[:, :7].all() and not by_column[:, 7:].any()  # column 6 opens at 0.6 s


@pytest.mark.parametrize("is_fly", [True, False])
def test_a_pulsed_scan_knows_when_it_needs_a_pose(is_fly) -> None:
    pulsed = scan(DARK_FROM, is_fly=is_fly)
    pulsed.check_timing()
    assert Static().cells(pulsed, 1).time_s[0] == pytest.approx(START_S + 0.55)
    # a protocol pulses in shares of the exposure
    protocol = Protocol(views=4, exposure_deg=10.0, readout_ratio=0.5, pulse=(0.5, 0.4), is_fly=is_fly)
    assert protocol.shutter().pulse_s == (0.5, 0.4)
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
