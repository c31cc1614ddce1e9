"""Multi-pose batch rendering: one launch per operator for all micro-views of a frame, equal to Eq. 3 written out."""

import numpy as np
import pytest
from kernel_kit import assert_near, note_launches, splat
from tolerances import BRUTE_FORCE, MICRO_VIEWS_FINE, MICRO_VIEWS_ORDER, STANDING_PICTURE

from phyradgs_cl.acquisition import CircularOrbit, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import exact_cells, micro_view_cells, per_line_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.operators import DeviceCells, SplatProjector
from phyradgs_cl.operators.twins.splat import splat_image
from phyradgs_cl.runtime import Runtime

SHAPE = (13, 18)
START_S = 0.4
AXES = pytest.mark.parametrize("axis", ["rows", "columns"])
DIRECTIONS = pytest.mark.parametrize("direction", [1, -1])


@pytest.fixture
def orbit(make_geometry) -> CircularOrbit:
    return CircularOrbit(make_geometry(*SHAPE, offset=(0.1, 0.2)), ConstantSpeed(0.3, 0.6))


def render(rt: Runtime, rows: np.ndarray, table: TimeCells, cutoff_sigma: float = 0.0) -> np.ndarray:
    return splat(rt, rows, table, SHAPE, cutoff_sigma=cutoff_sigma)


@AXES
@DIRECTIONS
def test_constant_speed_against_a_brute_force_average(rt, make_cloud, orbit, axis, direction) -> None:
    """Static projections at hundreds of times, each line averaging those within its own window."""
    shutter = Shutter(0.3, 0.4, axis, direction)
    lines, fine = shutter.lines(SHAPE), 24
    rows = make_cloud(3, 35)
    step_s = shutter.readout_s / (lines - 1)  # one line's delay, cut in ``fine`` / exposure lines below
    exposure_lines = 9
    shutter = Shutter(exposure_lines * step_s, shutter.readout_s, axis, direction)
    times = START_S + (np.arange((lines - 1 + exposure_lines) * fine) + 0.5) / fine * step_s
    images = np.stack([splat_image(rows, pose, SHAPE) for pose in orbit.pose(0, times)])
    assert len(images) > 400
    brute = np.zeros(SHAPE)
    for line in range(lines):
        first = (line if direction > 0 else lines - 1 - line) * fine
        mean = images[first : first + exposure_lines * fine].mean(axis=0)
        where = (line, slice(None)) if axis == "rows" else (slice(None), line)
        brute[where] = mean[where]

    where = (orbit, shutter, 0, START_S, lines)
    assert_near(render(rt, rows, per_line_cells(*where, exposure_lines * fine)), brute, BRUTE_FORCE)

    def error(strips: int, sub_intervals: int) -> float:
        frame = render(rt, rows, micro_view_cells(*where, strips, sub_intervals))
        return float(np.abs(frame - brute).max() / brute.max())

    coarse, fine_error = error(1, 1), error(lines, 12)
    assert fine_error <= MICRO_VIEWS_FINE
    assert coarse >= MICRO_VIEWS_ORDER * fine_error


def test_an_axially_symmetric_cloud_does_not_move(rt, make_geometry) -> None:
    rows = np.zeros((11, 3))
    rows[2], rows[3:5], rows[5] = [-0.5, 0.0, 0.4], [0.1, 0.3, 0.2], [0.2, 0.1, 0.3]
    rows[6], rows[10] = 1.0, [1.0, 0.5, 2.0]
    orbit = CircularOrbit(make_geometry(*SHAPE), ConstantSpeed(0.3, 0.6))
    where = (orbit, Shutter(0.5, 0.4), 0, START_S, SHAPE[0])
    static = render(rt, rows, static_cells(*where))
    for table in (micro_view_cells(*where, 4, 5), per_line_cells(*where, 3)):
        assert_near(render(rt, rows, table), static, STANDING_PICTURE)


def test_launches_do_not_grow_with_the_micro_views(banded_rt, make_cloud, orbit, monkeypatch) -> None:
    """Preparation, gather and both adjoint passes once a frame, 1 micro-view or 40 (no serial loop)."""
    launched, counts = note_launches(monkeypatch), []
    for strips, sub_intervals in ((1, 1), (8, 5)):
        table = micro_view_cells(orbit, Shutter(0.5, 0.4), 0, START_S, SHAPE[0], strips, sub_intervals)
        assert table.count == strips * sub_intervals
        launched.clear()
        cells = DeviceCells.upload(banded_rt, table)
        SplatProjector(banded_rt, *SHAPE).project_adjoint(make_cloud(4, 36), cells, np.ones(SHAPE))
        counts.append(list(launched))
    assert counts[0] == counts[1]
    for kernel in ("splat_prepare", "splat_forward_rows", "splat_backward_rows", "splat_chain"):
        assert counts[1].count(kernel) == 1


def test_a_gaussian_in_a_cell_takes_one_record(make_cloud, orbit) -> None:
    """64 bytes, 80 where it moves, and a mark: the adjoint's sums come in its place."""
    where, rows = (orbit, Shutter(0.5, 0.4), 0, START_S, SHAPE[0]), make_cloud(512, 37)
    for record_bytes, tables in (
        (65, [micro_view_cells(*where, 1, cells) for cells in (1, 41)]),
        (81, [exact_cells(*where, cells) for cells in (1, 41)]),
    ):
        held = []
        for table in tables:
            rt = Runtime()
            projector, cells = SplatProjector(rt, *SHAPE), DeviceCells.upload(rt, table)
            projector.project_adjoint(rows, cells, np.ones(SHAPE))
            held.append(rt.peak_bytes)
        assert record_bytes <= (held[1] - held[0]) / (40 * 512) < record_bytes + 2  # and a cell's constants
