"""Detector columns nearly parallel to z, and poses that serve many lines: other kernels, the same samples and weights."""

from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import note_launches
from memory_limits import PLANNED, room_for
from ray_tables import leaning, noise, tables
from remembered import remembered
from tolerances import RAYS, RAYS_BACK

from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import IntensityOperator, RayOperator
from phyradgs_cl.operators.rays.layout import RayLayout
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.rays.upright import columns_floats, upright_of
from phyradgs_cl.operators.twins.rays import ray_frame, ray_volume
from phyradgs_cl.runtime import Runtime

ray_frame, ray_volume = remembered(ray_frame), remembered(ray_volume)
GRID = Grid((19, 14, 23), (0.11, 0.13, 0.08), (0.1, -0.05, 0.2))
TALL_PANEL = (85, 7)


@pytest.fixture(scope="module", params=[8, pytest.param(16, marks=pytest.mark.slow)])
def cpu_rt(request: pytest.FixtureRequest) -> Runtime:
    return Runtime(lanes=request.param, pixel_items=False)


def general(rt: Runtime, grid: Grid, shape: tuple[int, int], cells: list[TimeCells]) -> RayOperator:
    """The operator without room for the turned volume."""
    layout = RayLayout.of_scan(rt, grid, shape, cells[0].axis)
    return RayOperator(rt, grid, shape, cells, memory=RayMemory(rt, layout, len(cells)))


def assert_same_bits(rt: Runtime, grid: Grid, cells: list[TimeCells], x: np.ndarray, shape=TALL_PANEL) -> np.ndarray:
    frames = RayOperator(rt, grid, shape, cells).forward(x)
    np.testing.assert_array_equal(frames, general(rt, grid, shape, cells).forward(x))
    return frames


def assert_frames(found: np.ndarray, cells: list[TimeCells], x: np.ndarray, shape=TALL_PANEL, model: str = "log") -> None:
    expected = np.stack([ray_frame(x, GRID, table, shape, model) for table in cells])
    assert np.abs(found - expected).max() <= RAYS * expected.max() and expected.max() > 0


def assert_volume(found: np.ndarray, cells: list[TimeCells], y: np.ndarray, grid: Grid = GRID) -> None:
    expected = sum(ray_volume(frame, grid, table) for frame, table in zip(y, cells, strict=True))
    assert np.abs(found - expected).max() <= RAYS_BACK * expected.max() and expected.max() > 0


@pytest.mark.parametrize(
    ("motion", "shape"),
    [("static", TALL_PANEL), ("static", (131, 18)), ("static", (96, 1)), ("micro-views", (131, 6)), ("common", TALL_PANEL)],
)
def test_frames_are_the_twins(cpu_rt, monkeypatch, motion, shape) -> None:
    """Of a pose that serves all lines to the bits of the general kernel; of several also as averages of intensities."""
    cells, x = tables(motion, shape, frames=2), noise(GRID.shape, 101)
    with monkeypatch.context() as patch:
        launched = note_launches(patch)
        frames = RayOperator(cpu_rt, GRID, shape, cells).forward(x)
    merged = {"merge_slots"} if motion != "static" else set()
    assert set(launched) == {"turn_upright", "rays_upright"} | merged
    assert_frames(frames, cells, x, shape)
    if motion == "static":
        assert_same_bits(cpu_rt, GRID, cells, x, shape)
    else:
        assert_frames(IntensityOperator(cpu_rt, GRID, shape, cells).expected(x), cells, x, shape, "intensity")


CLOSE = Grid((9, 30, 30), (0.05, 2 / 30, 2 / 30))
ODD = [Grid(voxels, (1.9 / voxels[0], 0.2, 0.3)) for voxels in ((1, 1, 1), (1, 33, 2), (40, 1, 17), (530, 3, 3))]


@pytest.mark.parametrize(("grid", "source_mm"), [*((grid, 5.0) for grid in ODD), (CLOSE, 0.4), (CLOSE, 1.3)])
def test_odd_volumes_and_a_source_inside_or_close_to_one(cpu_rt, grid, source_mm) -> None:
    """Also one higher than what a work-item blends of it."""
    cells = tables("static", TALL_PANEL, source_mm=source_mm)
    assert assert_same_bits(cpu_rt, grid, cells, noise(grid.shape, 102)).any()


def test_lines_without_cells_are_zero_and_give_nothing(banded_rt) -> None:
    whole, x = tables("micro-views", TALL_PANEL, frames=1)[0], noise(GRID.shape, 104)
    keep = whole.line_start != 17
    parts = {n: getattr(whole, n)[keep] for n in ("pose", "time_s", "line_start", "line_stop", "weight")}
    cells, y = [replace(whole, **parts)], noise((1, *TALL_PANEL), 109)
    frames = RayOperator(banded_rt, GRID, TALL_PANEL, cells).forward(x)
    assert_frames(frames, cells, x)
    assert not frames[0, 17:34].any() and frames[0, :17].any() and frames[0, 34:].any()
    for some in (cells, [whole]):
        assert_volume(RayOperator(banded_rt, GRID, TALL_PANEL, some).adjoint(y), some, y)


def test_a_subset_batches_of_frames_and_no_room_for_the_turned_volume(banded_rt, monkeypatch) -> None:
    rt = banded_rt
    cells, x = tables("static", TALL_PANEL, frames=5), noise(GRID.shape, 105)
    expected = RayOperator(rt, GRID, TALL_PANEL, cells).forward(x)
    operator, layout = RayOperator(rt, GRID, TALL_PANEL, cells), RayLayout.of_scan(rt, GRID, TALL_PANEL, "rows")
    volumes = layout.volume_floats + columns_floats(GRID) + 5 * operator.slot_floats + 32
    with room_for(rt, int(4 * (volumes + layout.frames_floats(2) + 16) / PLANNED)):
        assert [part.stop for part in operator.memory.batches(5)] == [2, 4, 5]
        np.testing.assert_array_equal(operator.forward(x), expected)
        np.testing.assert_array_equal(operator.subset([4, 1]).forward(x), expected[[4, 1]])
    del operator
    operator = RayOperator(rt, GRID, TALL_PANEL, cells)
    with room_for(rt, int(4 * (layout.volume_floats + layout.frames_floats(5) + 64) / PLANNED)):
        assert len(operator.memory.plan()) == 1
        launched = note_launches(monkeypatch)
        np.testing.assert_array_equal(operator.forward(x), expected)
        assert set(launched) == {"rays_forward"}


@pytest.mark.parametrize(("motion", "axis", "lean_deg", "shape"), [
    ("static", "rows", (0.01, 0.0), (85, 40)), ("static", "rows", (5.0, -6.0), (40, 131)),
    ("common", "rows", (-5.0, 3.0), (85, 40)), ("common", "columns", (0.3, 0.5), (40, 131)),
])  # fmt: skip
def test_panels_that_lean(cpu_rt, motion, axis, lean_deg, shape) -> None:
    """Frames and adjoint; some columns have rays of both main axes."""
    grid = replace(GRID, offset_mm=(0.0, -0.05, 0.1))
    cells = leaning(tables(motion, shape, axis, frames=2, direction=-1), *lean_deg)
    operator = RayOperator(cpu_rt, grid, shape, cells)
    assert operator._upright is not None and operator._upright.leans
    x, y = noise(grid.shape, 111), noise((2, *shape), 112)
    frames, volume = operator.forward(x), operator.adjoint(y)
    plain = general(cpu_rt, grid, shape, cells)
    assert np.abs(frames - plain.forward(x)).max() <= RAYS * frames.max() and frames.max() > 0
    assert np.abs(volume - plain.adjoint(y)).max() <= RAYS_BACK * volume.max()


@pytest.mark.parametrize(("motion", "count"), [("gapless", 4), ("overlapping", 2)])
def test_frames_without_gaps_share_their_poses_and_slots_stay_within_their_memory(cpu_rt, motion, count) -> None:
    """The end of a frame and the beginning of the next are projected once. Where their last and first lines are exposed
    together, a slot of both would have all lines."""
    shape = (85, 3)
    cells, x, y = tables(motion, shape, frames=count), noise(GRID.shape, 115), noise((count, *shape), 116)
    operator = RayOperator(cpu_rt, GRID, shape, cells)
    frames, slots = operator.forward(x), operator._slots[(0, count)]
    assert slots.count < sum(table.count for table in cells) - 5 or motion == "overlapping"
    assert slots.floats <= count * operator.slot_floats
    assert_frames(frames, cells, x, shape)
    assert_volume(operator.adjoint(y), cells, y)
    np.testing.assert_allclose(operator.subset([1, 0]).forward(x), frames[[1, 0]], rtol=0, atol=RAYS * frames.max())


ADJOINTS = {
    "static": (GRID, TALL_PANEL, {}), "a wide panel": (GRID, (131, 18), {"frames": 1}), "a column": (GRID, (96, 1), {}),
    "few lines per voxel": (Grid((38, 20, 22), (0.05, 0.06, 0.06)), (24, 9), {}),
    "many lines per voxel": (Grid((6, 9, 11), (0.3, 0.2, 0.15)), (150, 9), {}),
    "more voxels than a work-item's": (Grid((150, 20, 21), (0.013,) * 3, (0.0, 0.1, 0.0)), (85, 40), {}),
    "a voxel": (Grid((1, 1, 1), (1.9, 0.2, 0.3)), TALL_PANEL, {}),
    "a source close by": (Grid((9, 30, 30), (2 / 30,) * 3), TALL_PANEL, {"source_mm": 1.3}),
}


@pytest.mark.parametrize("case", ADJOINTS)
def test_the_adjoint_is_the_twins(cpu_rt, monkeypatch, case) -> None:
    grid, shape, changes = ADJOINTS[case]
    cells = tables("static", shape, **{"frames": 2, **changes})
    y = noise((len(cells), *shape), 108)
    with monkeypatch.context() as patch:
        launched = note_launches(patch)
        found = RayOperator(cpu_rt, grid, shape, cells).adjoint(y)
    assert set(launched) == {"split_slots", "rays_upright_adjoint"}
    assert_volume(found, cells, y, grid)


def test_the_adjoints_bits_do_not_tell_of_bricks_batches_or_where_frames_are(banded_rt) -> None:
    rt = banded_rt
    cells, y = tables("static", TALL_PANEL, frames=5), noise((5, *TALL_PANEL), 110)
    grid = Grid((40, 37, 13), (0.05, 0.05, 0.1))
    expected = RayOperator(rt, grid, TALL_PANEL, cells).adjoint(y)
    operator, layout = RayOperator(rt, grid, TALL_PANEL, cells), RayLayout.of_scan(rt, grid, TALL_PANEL, "rows")
    np.testing.assert_array_equal(rt.download(operator.adjoint(rt.upload(y))), expected)
    with room_for(rt, int(4 * (layout.volume_floats * 0.7 + layout.frames_floats(2)) / PLANNED)):
        small = RayOperator(rt, grid, TALL_PANEL, cells)
        assert len(small.memory.plan()) > 1 and len(list(small.memory.batches(5))) > 1
        np.testing.assert_array_equal(small.adjoint(y), expected)
        np.testing.assert_array_equal(small.subset([4, 1]).adjoint(y[[4, 1]]), operator.subset([4, 1]).adjoint(y[[4, 1]]))


def changed(roll: float, rise_mm: float = 0.0) -> list[TimeCells]:
    """Of panels whose columns lean along their rows, and that stand higher."""
    cells = tables("static", TALL_PANEL)
    for table in cells:
        table.pose[:, 9:12] += roll * table.pose[:, 6:9]
        table.pose[:, 5] += rise_mm
    return cells


def test_where_it_applies() -> None:
    """Of lines far apart in voxels a work-item takes fewer, and none where a vector of them is too many."""
    close = leaning(tables("static", TALL_PANEL, source_mm=1.3), 1.0, 0.0)
    cases = {
        "static": (tables("static", TALL_PANEL), False), "strips": (tables("micro-views", TALL_PANEL), False),
        "common": (tables("common", TALL_PANEL), False), "columns": (tables("static", TALL_PANEL, "columns"), False),
        "a pose per line": (tables("per line", TALL_PANEL), None), "few rows": (tables("static", (15, 85)), None),
        "tilted": (changed(1e-4), True), "lying": (changed(0.5), None), "steep": (changed(0.0, 30.0), None),
        "leaning from within": (close, None),
    }  # fmt: skip
    for name, (cells, leans) in cases.items():
        shape = (15, 85) if name == "few rows" else TALL_PANEL
        how = upright_of(GRID, cells, shape, 16)
        assert (None if how is None else how.leans) is leans, name
    fine = [Grid((9, 14, 11), (pitch_mm,) * 3) for pitch_mm in (1e-2, 5e-3, 1e-3)]
    ways = [upright_of(grid, tables("static", TALL_PANEL), TALL_PANEL, 16) for grid in fine]
    spacing_mm = 3.9 / TALL_PANEL[0]
    assert [way and way.block for way in ways] == [85, int(508 / (spacing_mm / 5e-3)), None]
