"""Multi-pose batch rendering: one launch per operator for all micro-views of a frame, equal to Eq. 3 written out."""

import numpy as np
import pytest
from kernel_kit import assert_near, frame_cells, note_launches, splat
from tolerances import BRUTE_FORCE, MICRO_VIEWS_FINE, MICRO_VIEWS_ORDER

from phyradgs_cl.acquisition import CircularOrbit, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import exact_cells, micro_view_cells, per_line_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector, Voxeliser
from phyradgs_cl.operators.splats import binning
from phyradgs_cl.operators.twins.splat import splat_image
from phyradgs_cl.runtime import Runtime

SHAPE = (13, 18)
START_S = 0.4


@pytest.fixture
def orbit(make_geometry) -> CircularOrbit:
    return CircularOrbit(make_geometry(*SHAPE, offset=(0.1, 0.2)), ConstantSpeed(0.3, 0.6))


def render(rt: Runtime, rows: np.ndarray, table: TimeCells, cutoff_sigma: float = 0.0) -> np.ndarray:
    return splat(rt, rows, table, SHAPE, cutoff_sigma=cutoff_sigma)


@pytest.mark.parametrize(("axis", "direction"), [("rows", 1), ("columns", -1)])
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


GRID = Grid.cube(18, 2.0)


@pytest.mark.parametrize("what", ["static", "exact", "intensity", "voxels"])
def test_lists_that_do_not_fit_give_the_same_bits(two_rt, make_cloud, make_geometry, what) -> None:
    rt, rows = two_rt, make_cloud(40, 7)
    gaussians = DeviceGaussians.upload(rt, rows)
    if what == "voxels":
        operator = Voxeliser(rt, GRID.shape)
        run = lambda: rt.download(operator.forward(gaussians, GRID))  # noqa: E731
    else:
        table = frame_cells("static" if what == "static" else "exact", make_geometry(40, 37))
        operator, cells = SplatProjector(rt, 40, 37, intensity_unit=2.0 if what == "intensity" else None), None
        cells = DeviceCells.upload(rt, table)
        run = lambda: rt.download(operator.forward(gaussians, cells))  # noqa: E731
    expected = run()
    needed = int(rt.download(operator.lists.tile_offsets)[-1])
    assert expected.any() and operator.lists.splat_ids.size > needed
    rt.finish()
    operator.lists.splat_ids = rt.empty(needed // 2, np.int32)
    operator.lists._needed = None  # the last number is of lists that fitted
    np.testing.assert_array_equal(run(), expected)
    np.testing.assert_array_equal(run(), expected)
    assert operator.lists.splat_ids.size > needed, "the number has come meanwhile"


@pytest.mark.parametrize("many", [binning._MANY_COUNTS, 1], ids=["short chunks", "long chunks"])
def test_a_gpus_lists_are_a_cpus(monkeypatch, many) -> None:
    """Clouds of less and more than a group, all in one tile or everywhere; more chunks and tiles than one scan takes."""
    monkeypatch.setattr(binning, "_MANY_COUNTS", many)
    shapes, rng = (Runtime(), Runtime(lanes=1, pixel_items=True)), np.random.default_rng(3)
    for count, tiles, largest in ((0, (3, 2, 1), 1), (1, (1, 1, 1), 1), (65, (9, 8, 2), 5), (9000, (5, 3, 1), 40)):
        tile = (4, 3, 2)
        size = np.multiply(tile, tiles)[:, None]
        low = rng.integers(0, size, (3, count + 7))
        high = np.minimum(low + rng.integers(-1, largest, low.shape), size - 1)
        high[1:] = np.maximum(high[1:], low[1:])  # the first axis tells what is nowhere
        extents, found = np.stack([low, high], 1).reshape(6, -1).astype(np.int32), []
        for rt in shapes:
            lists = binning.TileLists(rt, tile, tiles)
            lists.build(rt.upload(extents), count, count + 7)
            starts = rt.download(lists.tile_offsets)
            found.append((starts, rt.download(lists.splat_ids)[: starts[-1]]))
        np.testing.assert_array_equal(found[0][0], found[1][0], str(count))
        np.testing.assert_array_equal(found[0][1], found[1][1], str(count))
        assert count < 2 or found[0][0][-1] > count
