"""When each line opens, and which strip it belongs to."""

import math

import numpy as np
import pytest

from phyradgs_cl.acquisition import Shutter
from phyradgs_cl.errors import InputError


@pytest.mark.parametrize("lines", [2, 3, 64, 511])
def test_delay_is_the_papers_fraction_of_the_readout(lines) -> None:
    forward = Shutter(1.0, 0.86).delay_s(lines)
    np.testing.assert_allclose(forward, [r / (lines - 1) * 0.86 for r in range(lines)], rtol=1e-14)
    np.testing.assert_array_equal(Shutter(1.0, 0.86, direction=-1).delay_s(lines), forward[::-1])


def test_lines_and_the_span_of_their_delays() -> None:
    shutter = Shutter(0.4, 0.3, "columns", -1)
    delay_s = shutter.delay_s(9)
    assert shutter.span_s == pytest.approx(0.7)
    assert delay_s[8] == 0 and delay_s[0] + shutter.exposure_s == pytest.approx(shutter.span_s)
    np.testing.assert_array_equal(Shutter(1.0).delay_s(5), np.zeros(5))
    np.testing.assert_array_equal(Shutter(1.0, 0.5).delay_s(1), [0.0])
    assert Shutter(1.0, axis="rows").lines((7, 10)) == 7
    assert Shutter(1.0, axis="columns").lines((7, 10)) == 10


@pytest.mark.parametrize("direction", [1, -1])
def test_strip_of_a_line_is_floor_r_times_m_over_h(direction) -> None:
    for lines, strips in [(8, 8), (10, 4), (7, 3), (512, 8), (511, 16), (3, 8), (1, 5), (5, 1)]:
        ranges = Shutter(1.0, 0.5, direction=direction).strip_ranges(lines, strips)
        assert len(ranges) == strips
        strip_of = np.full(lines, -1)
        for strip, (start, stop) in enumerate(ranges):
            assert np.all(strip_of[start:stop] == -1), "a line in two strips"
            strip_of[start:stop] = strip
        order = np.arange(lines) if direction > 0 else np.arange(lines)[::-1]
        np.testing.assert_array_equal(strip_of, order * strips // lines)


def test_nonsense_is_refused() -> None:
    bad = (-1.0,), (math.nan,), (1.0, -0.1), (1.0, math.inf), (1.0, 0.1, "row"), (1.0, 0.1, "rows", 0)
    for arguments in bad:
        with pytest.raises(InputError):
            Shutter(*arguments)
