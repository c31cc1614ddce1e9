"""Detector columns parallel to z, and poses that serve many lines: another kernel, the same bits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from memory_limits import room_for
from ray_tables import noise, tables
from remembered import remembered
from tolerances import RAYS

from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator
from phyradgs_cl.operators.rays.layout import RayLayout
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.rays.upright import columns_floats, upright_block
from phyradgs_cl.operators.twins.rays import ray_frame
from phyradgs_cl.runtime import Runtime

ray_frame = remembered(ray_frame)
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


def launched(
    rt: Runtime, monkeypatch: pytest.MonkeyPatch, operator: RayOperator, volume: np.ndarray
) -> set[str]:
    names, launch = set(), Runtime.launch

    def noted(self: Runtime, kernel: object, *args: object, **options: object) -> None:
        names.add(kernel.function_name)  # type: ignore[attr-defined]
        launch(self, kernel, *args, **options)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(Runtime, "launch", noted)
        operator.forward(volume)
    return names


@pytest.mark.parametrize("motion", ["static", "micro-views"])
@pytest.mark.parametrize("shape", [TALL_PANEL, (131, 18), (96, 1)])
def test_the_same_bits_as_the_general_kernel(cpu_rt, monkeypatch, motion, shape) -> None:
    cells, x = tables(motion, shape, frames=2), noise(GRID.shape, 101)
    operator = RayOperator(cpu_rt, GRID, shape, cells)
    assert launched(cpu_rt, monkeypatch, operator, x) == {"turn_upright", "rays_upright"}
    frames = operator.forward(x)
    np.testing.assert_array_equal(frames, general(cpu_rt, GRID, shape, cells).forward(x))
    expected = np.stack([ray_frame(x, GRID, table, shape) for table in cells])
    assert np.abs(frames - expected).max() <= RAYS * expected.max() and expected.max() > 0


@pytest.mark.parametrize("voxels", [(1, 1, 1), (1, 33, 2), (40, 1, 17), (530, 3, 3)])
def test_odd_volumes(cpu_rt, voxels) -> None:
    """Also one higher than what a work-item blends of it."""
    grid = Grid(voxels, (1.9 / voxels[0], 0.2, 0.3))
    cells, x = tables("static", TALL_PANEL, frames=3), noise(voxels, 102)
    frames = RayOperator(cpu_rt, grid, TALL_PANEL, cells).forward(x)
    np.testing.assert_array_equal(frames, general(cpu_rt, grid, TALL_PANEL, cells).forward(x))
    assert frames.any()


@pytest.mark.parametrize("source_mm", [0.4, 1.3])
def test_source_inside_or_close_to_the_volume(cpu_rt, source_mm) -> None:
    grid, cells = Grid((9, 30, 30), (0.05, 2 / 30, 2 / 30)), tables("static", TALL_PANEL, source_mm=source_mm)
    x = noise(grid.shape, 103)
    frames = RayOperator(cpu_rt, grid, TALL_PANEL, cells).forward(x)
    np.testing.assert_array_equal(frames, general(cpu_rt, grid, TALL_PANEL, cells).forward(x))


def test_lines_without_cells_are_zero(cpu_rt) -> None:
    whole = tables("micro-views", TALL_PANEL, frames=1)[0]
    keep = whole.line_start != 17
    parts = {n: getattr(whole, n)[keep] for n in ("pose", "time_s", "line_start", "line_stop", "weight")}
    cells, x = [replace(whole, **parts)], noise(GRID.shape, 104)
    frames = RayOperator(cpu_rt, GRID, TALL_PANEL, cells).forward(x)
    assert not frames[0, 17:34].any() and frames[0, :17].any() and frames[0, 34:].any()
    np.testing.assert_array_equal(frames, general(cpu_rt, GRID, TALL_PANEL, cells).forward(x))


def test_a_subset_and_batches_of_frames(rt) -> None:
    cells, x = tables("static", TALL_PANEL, frames=5), noise(GRID.shape, 105)
    expected = RayOperator(rt, GRID, TALL_PANEL, cells).forward(x)
    operator = RayOperator(rt, GRID, TALL_PANEL, cells)
    layout = RayLayout.of_scan(GRID, TALL_PANEL, "rows")
    volumes = 4 * (layout.volume_floats + columns_floats(GRID))
    with room_for(rt, int((volumes + 4 * layout.frames_floats(2) + 64) / PLANNED)):
        assert [part.stop for part in operator.memory.batches(5)] == [2, 4, 5]
        np.testing.assert_array_equal(operator.forward(x), expected)
        np.testing.assert_array_equal(operator.subset([4, 1]).forward(x), expected[[4, 1]])


def test_without_room_for_the_turned_volume(rt, monkeypatch) -> None:
    cells, x = tables("static", TALL_PANEL), noise(GRID.shape, 106)
    expected = RayOperator(rt, GRID, TALL_PANEL, cells).forward(x)
    operator, layout = RayOperator(rt, GRID, TALL_PANEL, cells), RayLayout.of_scan(GRID, TALL_PANEL, "rows")
    with room_for(rt, int(4 * (layout.volume_floats + layout.frames_floats(3) + 64) / PLANNED)):
        assert len(operator.memory.plan()) == 1
        assert launched(rt, monkeypatch, operator, x) == {"rays_forward"}
        np.testing.assert_array_equal(operator.forward(x), expected)


def test_intensities_take_the_general_kernel(rt) -> None:
    cells, x = tables("micro-views", TALL_PANEL), noise(GRID.shape, 107)
    operator = RayOperator(rt, GRID, TALL_PANEL, cells)
    gap = operator.forward(x) - operator.project(x, "intensity")
    np.testing.assert_allclose(operator.intensity_gap(x), gap, atol=1e-5)
    assert gap.max() > 1e-3


def tilted(shape: tuple[int, int]) -> list[TimeCells]:
    cells = tables("static", shape)
    for table in cells:
        table.pose[:, 9:12] += 1e-4 * table.pose[:, 6:9]
    return cells


def steep(shape: tuple[int, int]) -> list[TimeCells]:
    cells = tables("static", shape)
    for table in cells:
        table.pose[:, 5] += 30.0
    return cells


@pytest.mark.parametrize(
    ("cells", "applies"),
    [
        (tables("static", TALL_PANEL), True),
        (tables("micro-views", TALL_PANEL), True),
        (tables("per line", TALL_PANEL), False),
        (tables("static", (15, 85)), False),
        (tables("static", (7, 85), "columns"), False),
        (tilted(TALL_PANEL), False),
        (steep(TALL_PANEL), False),
    ],
    ids=["static", "strips", "a pose per line", "few lines", "columns", "tilted", "steep"],
)
def test_where_it_applies(cells, applies) -> None:
    width = 85 if cells[0].lines == 15 else 7
    assert (upright_block(GRID, cells, width, 16) > 0) == applies


def test_lines_far_apart_in_voxels() -> None:
    """A work-item takes fewer lines then, and none where a vector of them is too many."""
    fine = [Grid((9, 14, 11), (pitch_mm,) * 3) for pitch_mm in (1e-2, 5e-3, 1e-3)]
    cells = tables("static", TALL_PANEL)
    blocks = [upright_block(grid, cells, TALL_PANEL[1], 16) for grid in fine]
    spacing_mm = 3.9 / TALL_PANEL[0]
    assert blocks == [85, int(508 / (spacing_mm / 5e-3)), 0]
