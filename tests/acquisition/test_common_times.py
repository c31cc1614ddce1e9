"""Cells on one grid of times for all lines: shares, ends, and how exactly they stand for many times of each line."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from ray_tables import noise
from tolerances import COMMON_TIMES

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, EncoderTable, PerRow, Shutter
from phyradgs_cl.acquisition.cells import common_time_cells, per_line_cells
from phyradgs_cl.acquisition.motion import with_times
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.api import simulate
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import IntensityOperator, RayOperator
from phyradgs_cl.reconstructors.voxels.fista import _few_times
from phyradgs_cl.runtime import Runtime

GEOMETRY = ConeGeometry(500.0, 800.0, (24, 20), (4.0, 4.0))
ORBIT = CircularOrbit(GEOMETRY, ConstantSpeed(0.3, np.deg2rad(14.4)))
SHUTTERS = {
    "rows": Shutter(1.0, 0.86), "upwards": Shutter(1.0, 0.86, direction=-1), "columns": Shutter(1.0, 0.5, "columns"),
    "global": Shutter(1.0), "slow": Shutter(1.0, 1.7), "pulsed": Shutter(1.0, 0.5, pulse_s=(0.4, 0.7)),
    "odd": Shutter(0.37, 0.2),
}  # fmt: skip


def cells(shutter: Shutter, samples: int = 5) -> TimeCells:
    return common_time_cells(ORBIT, shutter, 1, np.arange(3.0), shutter.lines(GEOMETRY.detector_shape), samples)


@pytest.mark.parametrize("name", SHUTTERS)
def test_shares_are_those_of_windows(name) -> None:
    shutter, table = SHUTTERS[name], cells(SHUTTERS[name], 7)
    assert table.line_share is not None
    np.testing.assert_allclose(table.line_weights(), 1, atol=1e-12)
    served = table.line_share > 0
    for cell, lines in enumerate(table.ranges):
        assert served[cell, lines].all() and served[cell].sum() == lines.stop - lines.start
    windows_s = 1.0 + shutter.line_windows_s(table.lines)
    step_s = np.ptp(shutter.line_windows_s(table.lines), axis=1).max() / 7
    mean_s, is_lit = table.time_s @ table.line_share, np.ptp(windows_s, axis=1) > 0
    assert np.abs(mean_s - windows_s.mean(1))[is_lit].max() <= step_s / 4
    np.testing.assert_array_equal(table.pose, ORBIT.pose(1, table.time_s))
    assert np.abs(table.layer_weights.sum(0) - 1).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("name", SHUTTERS)
@pytest.mark.parametrize("model", ["log", "intensity"])
def test_frames_are_those_of_many_times_of_each_line(rt: Runtime, name, model) -> None:
    """At 5 times to an exposure: as exact as 5 times of each line's own, within a third."""
    shutter, grid = SHUTTERS[name], Grid.cube(24, 260.0)
    x = np.zeros(grid.shape, np.float32)
    x[4:20, 5:19, 3:17] = 0.01 * (1 + noise((16, 14, 14), 3))
    lines, shape = shutter.lines(GEOMETRY.detector_shape), GEOMETRY.detector_shape
    tables = [cells(shutter), *(per_line_cells(ORBIT, shutter, 1, 1.0, lines, n) for n in (96, 5))]
    operators = {
        "log": lambda t: RayOperator(rt, grid, shape, [t]).forward(x),
        "intensity": lambda t: IntensityOperator(rt, grid, shape, [t]).expected(x),
    }
    common, exact, own = map(operators[model], tables)
    scale = np.sqrt(np.mean(exact**2))
    error, its_error = (np.sqrt(np.mean((frames - exact) ** 2)) / scale for frames in (common, own))
    assert error <= COMMON_TIMES and error <= 1.34 * its_error


def test_no_time_is_beyond_the_scan() -> None:
    """An encoder's table is never extrapolated."""
    shutter = SHUTTERS["rows"]
    time_s = np.array([0.0, 2.0 + shutter.span_s])
    orbit = CircularOrbit(GEOMETRY, EncoderTable(time_s, 0.2 * time_s))
    for frame in range(3):
        table = common_time_cells(orbit, shutter, frame, np.arange(3.0), 24, 5)
        assert table.time_s.min() > frame and table.time_s.max() <= 2 + shutter.span_s


@pytest.mark.parametrize("shutter, samples", [(Shutter(0.0, 0.5), 1), (Shutter(0.01, 2.0), 5)])
def test_lines_with_nothing_to_share_have_times_of_their_own(shutter, samples) -> None:
    table = cells(shutter)
    assert table.line_share is None and table.count == 24 * samples


def test_a_model_keeps_its_class_with_as_many_times_as_a_scan_needs() -> None:
    @dataclass(frozen=True)
    class Late(PerRow):
        name: str = field(default="late", init=False, repr=False)

    fly = simulate("spheres", size=16, detector=8, views=3, exposure_deg=40.0)
    timed = with_times(Late(), fly)
    assert type(timed) is Late and timed.sub_intervals == with_times(PerRow(), fly).sub_intervals > 2
    assert type(_few_times(timed)) is Late and _few_times(timed).sub_intervals == 2
