"""Detector columns parallel to z, and poses that serve many lines: other kernels; of frames the same bits."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import note_launches
from memory_limits import room_for
from ray_tables import noise, tables
from remembered import remembered
from tolerances import RAYS, RAYS_BACK

from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.operators.rays.layout import RayLayout
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.rays.upright import columns_floats, serve_one_line_each, upright_block
from phyradgs_cl.operators.twins.rays import ray_frame, ray_volume
from phyradgs_cl.runtime import Runtime

ray_frame, ray_volume = remembered(ray_frame), remembered(ray_volume)
GRID = Grid((19, 14, 23), (0.11, 0.13, 0.08), (0.1, -0.05, 0.2))
TALL_PANEL = (85, 7)
PLANNED = 0.9  # share of free memory that is planned with


@pytest.fixture(scope="module", params=[1, 4, 8, 16])
def cpu_rt(request: pytest.FixtureRequest) -> Runtime:
    return Runtime(lanes=request.param, pixel_items=False)


def general(rt: Runtime, grid: Grid, shape: tuple[int, int], cells: list[TimeCells]) -> RayOperator:
    """The operator without room for the turned volume."""
    layout = RayLayout.of_scan(grid, shape, cells[0].axis)
    return RayOperator(rt, grid, shape, cells, memory=RayMemory(rt, layout, len(cells)))


def assert_same_bits(
    rt: Runtime, grid: Grid, cells: list[TimeCells], x: np.ndarray, shape=TALL_PANEL
) -> np.ndarray:
    frames = RayOperator(rt, grid, shape, cells).forward(x)
    np.testing.assert_array_equal(frames, general(rt, grid, shape, cells).forward(x))
    return frames


@pytest.mark.parametrize("motion", ["static", "micro-views"])
@pytest.mark.parametrize("shape", [TALL_PANEL, (131, 18), (96, 1)])
def test_the_same_bits_as_the_general_kernel(cpu_rt, monkeypatch, motion, shape) -> None:
    cells, x = tables(motion, shape, frames=2), noise(GRID.shape, 101)
    with monkeypatch.context() as patch:
        launched = note_launches(patch)
        RayOperator(cpu_rt, GRID, shape, cells).forward(x)
    assert set(launched) == {"turn_upright", "rays_upright"}
    frames = assert_same_bits(cpu_rt, GRID, cells, x, shape)
    expected = np.stack([ray_frame(x, GRID, table, shape) for table in cells])
    assert np.abs(frames - expected).max() <= RAYS * expected.max() and expected.max() > 0


@pytest.mark.parametrize("voxels", [(1, 1, 1), (1, 33, 2), (40, 1, 17), (530, 3, 3)])
def test_odd_volumes(cpu_rt, voxels) -> None:
    """Also one higher than what a work-item blends of it."""
    grid, cells = Grid(voxels, (1.9 / voxels[0], 0.2, 0.3)), tables("static", TALL_PANEL, frames=3)
    assert assert_same_bits(cpu_rt, grid, cells, noise(voxels, 102)).any()


@pytest.mark.parametrize("source_mm", [0.4, 1.3])
def test_source_inside_or_close_to_the_volume(cpu_rt, source_mm) -> None:
    grid, cells = Grid((9, 30, 30), (0.05, 2 / 30, 2 / 30)), tables("static", TALL_PANEL, source_mm=source_mm)
    assert_same_bits(cpu_rt, grid, cells, noise(grid.shape, 103))


def test_lines_without_cells_are_zero(cpu_rt) -> None:
    whole = tables("micro-views", TALL_PANEL, frames=1)[0]
    keep = whole.line_start != 17
    parts = {n: getattr(whole, n)[keep] for n in ("pose", "time_s", "line_start", "line_stop", "weight")}
    frames = assert_same_bits(cpu_rt, GRID, [replace(whole, **parts)], noise(GRID.shape, 104))
    assert not frames[0, 17:34].any() and frames[0, :17].any() and frames[0, 34:].any()


def test_a_subset_and_batches_of_frames(banded_rt) -> None:
    rt = banded_rt
    cells, x = tables("static", TALL_PANEL, frames=5), noise(GRID.shape, 105)
    expected = RayOperator(rt, GRID, TALL_PANEL, cells).forward(x)
    operator = RayOperator(rt, GRID, TALL_PANEL, cells)
    layout = RayLayout.of_scan(GRID, TALL_PANEL, "rows")
    volumes = 4 * (layout.volume_floats + columns_floats(GRID))
    with room_for(rt, int((volumes + 4 * layout.frames_floats(2) + 64) / PLANNED)):
        assert [part.stop for part in operator.memory.batches(5)] == [2, 4, 5]
        np.testing.assert_array_equal(operator.forward(x), expected)
        np.testing.assert_array_equal(operator.subset([4, 1]).forward(x), expected[[4, 1]])


def test_without_room_for_the_turned_volume(banded_rt, monkeypatch) -> None:
    rt = banded_rt
    cells, x = tables("static", TALL_PANEL), noise(GRID.shape, 106)
    expected = RayOperator(rt, GRID, TALL_PANEL, cells).forward(x)
    operator, layout = RayOperator(rt, GRID, TALL_PANEL, cells), RayLayout.of_scan(GRID, TALL_PANEL, "rows")
    with room_for(rt, int(4 * (layout.volume_floats + layout.frames_floats(3) + 64) / PLANNED)):
        assert len(operator.memory.plan()) == 1
        launched = note_launches(monkeypatch)
        np.testing.assert_array_equal(operator.forward(x), expected)
        assert set(launched) == {"rays_forward"}


def test_intensities_take_the_general_kernel(rt) -> None:
    cells, x = tables("micro-views", TALL_PANEL), noise(GRID.shape, 107)
    operator = RayOperator(rt, GRID, TALL_PANEL, cells)
    gap = operator.forward(x) - operator.project(x, "intensity")
    np.testing.assert_allclose(operator.intensity_gap(x), gap, atol=1e-5)
    assert gap.max() > 1e-3


def adjoint_of_twins(cells: list[TimeCells], grid: Grid, y: np.ndarray) -> np.ndarray:
    return sum(ray_volume(frame, grid, table) for frame, table in zip(y, cells, strict=True))


ADJOINTS = {
    "static": (GRID, TALL_PANEL, {}), "a wide panel": (GRID, (131, 18), {}), "a column": (GRID, (96, 1), {}),
    "few lines per voxel": (Grid((38, 20, 22), (0.05, 0.06, 0.06)), (24, 9), {}),
    "many lines per voxel": (Grid((6, 9, 11), (0.3, 0.2, 0.15)), (150, 9), {}),
    "more voxels than a work-item's": (Grid((150, 20, 21), (0.013,) * 3, (0.0, 0.1, 0.0)), (85, 40), {}),
    "a voxel": (Grid((1, 1, 1), (1.9, 0.2, 0.3)), TALL_PANEL, {}),
    "a source close by": (Grid((9, 30, 30), (2 / 30,) * 3), TALL_PANEL, {"source_mm": 1.3}),
}


@pytest.mark.parametrize("case", ADJOINTS)
def test_the_adjoint_is_the_twins(cpu_rt, monkeypatch, case) -> None:
    grid, shape, source = ADJOINTS[case]
    cells = tables("static", shape, **source)
    y = noise((3, *shape), 108)
    with monkeypatch.context() as patch:
        launched = note_launches(patch)
        found = RayOperator(cpu_rt, grid, shape, cells).adjoint(y)
    assert set(launched) == {"weigh_columns", "rays_upright_adjoint"}
    expected = adjoint_of_twins(cells, grid, y)
    assert np.abs(found - expected).max() <= RAYS_BACK * expected.max() and expected.max() > 0


def test_strips_and_lines_without_cells_go_back_too(cpu_rt) -> None:
    """A cell per line; several cells take the general kernel."""
    (cells,), y = tables("micro-views", TALL_PANEL, frames=1), noise((1, *TALL_PANEL), 109)
    first_of_each = np.unique(cells.line_start, return_index=True)[1][[0, 2, 4]]
    parts = {n: getattr(cells, n)[first_of_each] for n in ("pose", "time_s", "line_start", "line_stop", "weight")}
    strips = replace(cells, **parts)
    assert serve_one_line_each([strips]) and not serve_one_line_each([cells])
    expected = ray_volume(y[0], GRID, strips)
    found = RayOperator(cpu_rt, GRID, TALL_PANEL, [strips]).adjoint(y)
    assert np.abs(found - expected).max() <= RAYS_BACK * expected.max()


def test_the_adjoints_bits_do_not_tell_of_bricks_batches_or_where_frames_are(banded_rt) -> None:
    rt = banded_rt
    cells, y = tables("static", TALL_PANEL, frames=5), noise((5, *TALL_PANEL), 110)
    grid = Grid((40, 37, 13), (0.05, 0.05, 0.1))
    expected = RayOperator(rt, grid, TALL_PANEL, cells).adjoint(y)
    operator, layout = RayOperator(rt, grid, TALL_PANEL, cells), RayLayout.of_scan(grid, TALL_PANEL, "rows")
    np.testing.assert_array_equal(rt.download(operator.adjoint(rt.upload(y))), expected)
    with room_for(rt, int(4 * (layout.volume_floats * 0.7 + layout.frames_floats(2)) / PLANNED)):
        small = RayOperator(rt, grid, TALL_PANEL, cells)
        assert len(small.memory.plan()) > 1 and len(list(small.memory.batches(5))) > 1
        np.testing.assert_array_equal(small.adjoint(y), expected)
        np.testing.assert_array_equal(small.subset([4, 1]).adjoint(y[[4, 1]]), operator.subset([4, 1]).adjoint(y[[4, 1]]))


def changed(change: Callable[[np.ndarray], None]) -> list[TimeCells]:
    cells = tables("static", TALL_PANEL)
    for table in cells:
        change(table.pose)
    return cells


def tilt(pose: np.ndarray) -> None:
    pose[:, 9:12] += 1e-4 * pose[:, 6:9]


def steepen(pose: np.ndarray) -> None:
    pose[:, 5] += 30.0


def test_where_it_applies() -> None:
    cases = {
        "static": (tables("static", TALL_PANEL), True), "strips": (tables("micro-views", TALL_PANEL), True),
        "a pose per line": (tables("per line", TALL_PANEL), False),
        "few lines": (tables("static", (15, 85)), False),
        "columns": (tables("static", (7, 85), "columns"), False),
        "tilted": (changed(tilt), False), "steep": (changed(steepen), False),
    }  # fmt: skip
    for name, (cells, applies) in cases.items():
        width = 85 if cells[0].lines == 15 else 7
        assert (upright_block(GRID, cells, width, 16) > 0) == applies, name


def test_lines_far_apart_in_voxels() -> None:
    """A work-item takes fewer lines then, and none where a vector of them is too many."""
    fine = [Grid((9, 14, 11), (pitch_mm,) * 3) for pitch_mm in (1e-2, 5e-3, 1e-3)]
    cells = tables("static", TALL_PANEL)
    blocks = [upright_block(grid, cells, TALL_PANEL[1], 16) for grid in fine]
    spacing_mm = 3.9 / TALL_PANEL[0]
    assert blocks == [85, int(508 / (spacing_mm / 5e-3)), 0]
