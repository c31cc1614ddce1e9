"""Lists of splats per tile that outgrow their memory: nobody waits, nothing is lost, and the next ones fit."""

import numpy as np
import pytest
from kernel_kit import frame_cells

from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector, Voxeliser
from phyradgs_cl.operators.splats import binning
from phyradgs_cl.runtime import Runtime

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


def test_only_another_cloud_is_waited_for(rt, make_cloud, make_geometry) -> None:
    projector, cells = SplatProjector(rt, 13, 18), DeviceCells.upload(rt, frame_cells("static", make_geometry(13, 18)))

    def waits(count: int) -> int:
        gaussians = DeviceGaussians.upload(rt, make_cloud(count, count))
        before = rt.traffic.blocking
        projector.forward(gaussians, cells)
        return rt.traffic.blocking - before

    assert [waits(count) for count in (30, 30, 30, 31, 31)] == [1, 0, 0, 1, 0]
