"""A scan's projector and its adjoint in one launch each: twins, subsets, repeatable bits."""

from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import launches
from ray_tables import SHAPE, noise, tables
from remembered import remembered
from tolerances import FLOAT32, RAYS, RAYS_BACK

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import IntensityOperator, RayOperator
from phyradgs_cl.operators.rays import general as rays
from phyradgs_cl.operators.twins.rays import ray_frame, ray_volume
from phyradgs_cl.runtime import Runtime

ray_frame, ray_volume = remembered(ray_frame), remembered(ray_volume)
GRID = Grid((9, 14, 11), (0.21, 0.13, 0.16), (0.1, -0.05, 0.2))
FRAMES = {"static": 2, "micro-views": 2, "per line": 1, "per line at one time": 2, "common": 2}


def check_twins(operator: RayOperator) -> None:
    x, y = noise(operator.volume_shape, 73), noise(operator.frames_shape, 74)
    grid, cells = operator.grid, operator.tables
    expected = np.stack([ray_frame(x, grid, table, operator.detector_shape) for table in cells])
    assert np.abs(operator.forward(x) - expected).max() <= RAYS * expected.max()
    expected = sum(ray_volume(frame, grid, table) for frame, table in zip(y, cells, strict=True))
    assert np.abs(operator.adjoint(y) - expected).max() <= RAYS_BACK * expected.max()


@pytest.mark.parametrize("motion", [*FRAMES][:4])
def test_frames_and_volumes_are_the_twins(any_rt, motion) -> None:
    check_twins(RayOperator(any_rt, GRID, SHAPE, tables(motion, SHAPE, "columns", -1, FRAMES[motion])))


@pytest.mark.parametrize(("motion", "shape", "beam"), [
    ("static", (1, 37), "cone"), ("micro-views", (1, 37), "cone"), ("per line", (1, 37), "cone"),
    ("per line", (3, 20), "parallel"), ("per line at one time", (3, 20), "parallel"), ("common", (3, 20), "parallel"),
])  # fmt: skip
def test_columns_of_few_rows(two_rt, motion, shape, beam) -> None:
    """Vectors run over columns that have weights of their own, and over the ends of their cells."""
    operator = RayOperator(two_rt, GRID, shape, tables(motion, shape, "columns", -1, FRAMES[motion], beam=beam))
    check_twins(operator)
    volume = noise(GRID.shape, 75)
    again = RayOperator(two_rt, GRID, shape, operator.tables, memory=operator.memory)
    np.testing.assert_array_equal(again.forward(volume), operator.forward(volume))
    expected = np.stack([ray_frame(volume, GRID, table, shape, "intensity") for table in operator.tables])
    found = IntensityOperator(two_rt, GRID, shape, operator.tables).expected(volume)
    assert np.abs(found - expected).max() <= RAYS * expected.max()


def pointing(axis: int) -> TimeCells:
    """A source before the volume on one axis, and the detector behind: all rays have this main axis."""
    along, b, c = np.eye(3)[[axis, (axis + 1) % 3, (axis + 2) % 3]]
    pose = np.concatenate([6 * along + 0.1 * b, -3 * along - 1.2 * b - c, 0.2 * b, 0.2 * c])
    one = np.ones(1)
    return TimeCells(pose[None], 0 * one, np.array([0]), np.array([SHAPE[0]]), one, SHAPE[0])


def test_rays_along_each_axis_and_odd_detectors(rt) -> None:
    for axis in range(3):
        check_twins(RayOperator(rt, GRID, SHAPE, [pointing(axis)]))
    for shape in ((1, 1), (1, 20), (17, 5), (21, 11)):
        check_twins(RayOperator(rt, GRID, shape, tables("micro-views", shape, frames=1)))


SEVERAL, CUBE = Grid((17, 70, 37), (0.11, 0.03, 0.05), (0.05, 0.1, -0.1)), Grid.cube(26, 2.0)
ODD = [Grid(shape, (0.9, 0.11, 0.13)) for shape in ((1, 1, 1), (1, 16, 1), (3, 1, 33), (24, 25, 24))]


@pytest.mark.parametrize(("grid", "shape", "motion", "more"), [
    *((grid, (7, 11), "per line", {"frames": 1}) for grid in ODD),
    *((SEVERAL, (7, 37), motion, {"frames": 2}) for motion in ("static", "per line at one time")),
    *((CUBE, SHAPE, how, {"frames": 1, "source_mm": mm}) for how in ("static", "micro-views") for mm in (0.4, 0.9, 1.3)),
])  # fmt: skip
def test_odd_volumes_of_several_bricks_and_around_or_close_to_the_source(two_rt, grid, shape, motion, more) -> None:
    """Samples between two owners count once; vectors of rays with two main axes; a detector of several vectors. Planes
    behind the source do not count, and no bound exists for bricks that its plane cuts."""
    check_twins(RayOperator(two_rt, grid, shape, tables(motion, shape, **more)))


def test_volumes_out_of_sight_and_other_arrays_than_float32_in_c_order(rt) -> None:
    far = Grid((4, 5, 6), (0.1, 0.1, 0.1), (3.0, 0.0, 0.0))
    operator = RayOperator(rt, far, SHAPE, tables("micro-views"))
    assert not operator.forward(noise(far.shape, 75)).any()
    assert not operator.adjoint(noise(operator.frames_shape, 76)).any()
    operator = RayOperator(rt, GRID, SHAPE, tables("static"))
    x, y = noise(GRID.shape, 87), noise(operator.frames_shape, 88)
    turned = np.asfortranarray(x.astype(np.float64))
    np.testing.assert_array_equal(operator.forward(turned), operator.forward(x))
    np.testing.assert_array_equal(operator.adjoint(np.asfortranarray(y)), operator.adjoint(y))


def test_lines_without_cells_are_zero_and_give_nothing(rt) -> None:
    """Tables need not be complete; the lines between cells stay empty in both directions."""
    whole = tables("per line", frames=1)[0]
    keep = (whole.line_start < 3) | (whole.line_start > 7)
    parts = {n: getattr(whole, n)[keep] for n in ("pose", "time_s", "line_start", "line_stop", "weight")}
    operator = RayOperator(rt, GRID, SHAPE, [replace(whole, **parts)])
    check_twins(operator)
    assert not operator.forward(noise(GRID.shape, 77))[0, 3:8].any()


def test_a_gpus_launches_of_bounded_length_have_the_bits_of_one(monkeypatch) -> None:
    """Drivers of screens end long ones; a CPU's has no such limit. All cells of a line count."""
    x, y, cells = noise(GRID.shape, 90), noise((4, *SHAPE), 91), tables("micro-views", frames=4)
    per_line = max(int(np.ptp(table.line_cells(), axis=1).max()) for table in cells)
    launched = launches(monkeypatch)
    for shape, frames_of_launch in (({"lanes": 1, "pixel_items": True}, 2), ({"pixel_items": False}, 4)):
        operator = RayOperator(Runtime(**shape), GRID, SHAPE, cells)
        forward, adjoint = operator.forward(x), operator.adjoint(y)
        with monkeypatch.context() as patch:
            launched.clear()
            patch.setattr(Runtime, "most_samples", 2 * per_line * rays._SAMPLES_PER_VOXEL * x.size)
            np.testing.assert_array_equal(operator.adjoint(y), adjoint)
            patch.setattr(Runtime, "most_samples", 2 * per_line * y[0].size * max(GRID.shape))
            np.testing.assert_array_equal(operator.forward(x), forward)
        found = [name for name, *_ in launched if name.startswith("rays_")]
        assert found == ["rays_adjoint"] * (4 // frames_of_launch) + ["rays_forward"] * (4 // frames_of_launch)


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_subsets_are_rows_of_the_operator_and_bits_repeat(two_rt, axis) -> None:
    operator = RayOperator(two_rt, GRID, SHAPE, tables("micro-views", axis=axis, frames=4))
    x, y = noise(GRID.shape, 81), noise(operator.frames_shape, 82)
    frames = operator.forward(x)
    singles = [RayOperator(two_rt, GRID, SHAPE, [table]).forward(x)[0] for table in operator.tables]
    np.testing.assert_array_equal(frames, singles)
    np.testing.assert_array_equal(operator.adjoint(y), operator.adjoint(y))
    part = operator.subset([3, 0])
    assert part.frames_shape == (2, *SHAPE) and part.volume_shape == GRID.shape
    np.testing.assert_array_equal(part.forward(x), frames[[3, 0]])
    np.testing.assert_array_equal(part.subset([1]).forward(x), frames[:1])
    only = np.where(np.isin(np.arange(4), [0, 3])[:, None, None], y, 0)
    np.testing.assert_allclose(part.adjoint(y[[3, 0]]), operator.adjoint(only), rtol=FLOAT32, atol=1e-6)
    np.testing.assert_array_equal(operator.forward(x), frames)


def test_stacks_larger_than_an_allocation_and_bricks_for_little_local_memory(rt, monkeypatch) -> None:
    cells = tables("micro-views", frames=17)
    whole = RayOperator(rt, GRID, SHAPE, cells)
    x, y = noise(GRID.shape, 83), noise(whole.frames_shape, 84)
    expected = whole.forward(x), whole.adjoint(y)
    monkeypatch.setattr(rt, "device", replace(rt.device, largest_allocation_bytes=23_000))
    parts = RayOperator(rt, GRID, SHAPE, cells)
    assert parts.memory.plan() == whole.memory.plan()
    assert 1 < len(list(parts.memory.batches(17))) < 17
    np.testing.assert_array_equal(parts.forward(x), expected[0])
    np.testing.assert_array_equal(parts.adjoint(y), expected[1])
    monkeypatch.undo()
    operator = RayOperator(rt, Grid((17, 33, 27), (0.11, 0.06, 0.07)), SHAPE, cells[:3])
    usual = operator.adjoint(y[:3])
    monkeypatch.setattr(rays, "_BRICK", (10**6, 1, 1))
    np.testing.assert_allclose(operator.adjoint(y[:3]), usual, rtol=FLOAT32, atol=1e-6)
