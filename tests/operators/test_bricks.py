"""Volumes that do not fit the device are taken in bricks: the same result, within the limit, in every direction of a cut.

Backprojections of device arrays: what they make of NumPy's, bit for bit, and only poses cross the bus."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import assert_near
from memory_limits import refuse_large, room_for
from ray_tables import noise, tables
from refusals import assert_refused
from tolerances import BRICKS

from phyradgs_cl.errors import OutOfMemoryError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import (
    IntensityOperator,
    RayOperator,
    Voxeliser,
    backproject,
    backproject_lines,
    voxelise,
)
from phyradgs_cl.operators.rays import general as rays
from phyradgs_cl.operators.splats import binning

pytestmark = pytest.mark.slow

SHAPE = (7, 37)
TALL = Grid((21, 70, 37), (0.09, 0.03, 0.05), (0.05, 0.1, -0.1))
Z_ONLY, Z_AND_Y = 320_000, 130_000  # bytes of room for TALL: cuts along z, and along both


@pytest.mark.parametrize(("motion", "axis", "nbytes"), [
    ("static", "rows", Z_ONLY), ("static", "columns", Z_AND_Y), ("per line", "columns", Z_ONLY),
    ("per line", "rows", Z_AND_Y),
])  # fmt: skip
def test_rays(two_rt, motion, axis, nbytes) -> None:
    cells = tables(motion, SHAPE, axis, frames=5)
    operator = RayOperator(two_rt, TALL, SHAPE, cells)
    x, y = noise(TALL.shape, 91), noise(operator.frames_shape, 92)
    expected, back = operator.forward(x), operator.adjoint(y)
    seen = IntensityOperator(two_rt, TALL, SHAPE, cells).expected(x)
    parts = RayOperator(two_rt, TALL, SHAPE, cells)
    part = parts.subset([3, 1])
    volume, frames, summed = two_rt.upload(x), two_rt.upload(y), two_rt.empty(x.shape)
    with room_for(two_rt, nbytes):
        bricks = parts.memory.plan()
        assert len({b.start[0] for b in bricks}) > 1
        assert (len({b.start[1] for b in bricks}) > 1) == (nbytes == Z_AND_Y)
        np.testing.assert_array_equal(parts.adjoint(y), back)
        assert np.abs(parts.forward(x) - expected).max() <= BRICKS * expected.max()
        few = part.forward(x)
        if nbytes == Z_ONLY:  # arrays that are on the device are cut there
            assert np.abs(two_rt.download(parts.forward(volume)) - expected).max() <= BRICKS * expected.max()
            np.testing.assert_array_equal(two_rt.download(parts.adjoint(frames, summed)), back)
    assert np.abs(few - expected[[3, 1]]).max() <= BRICKS * expected.max()
    if motion == "per line":  # layers bring tables of their own
        with room_for(two_rt, nbytes + 120_000):
            found = IntensityOperator(two_rt, TALL, SHAPE, cells).expected(x)
        assert np.abs(found - seen).max() <= 2 * BRICKS * expected.max()
        assert (expected - seen).max() > 1e-4


def test_indices_of_64_bits_change_nothing_in_bricks(two_rt, monkeypatch) -> None:
    cells, x = tables("per line", SHAPE, frames=1), noise(TALL.shape, 93)
    expected = RayOperator(two_rt, TALL, SHAPE, cells).forward(x)
    back = RayOperator(two_rt, TALL, SHAPE, cells).adjoint(expected)
    monkeypatch.setattr(rays, "_LONG_FROM", 0)
    with room_for(two_rt, Z_AND_Y + 120_000):
        long = RayOperator(two_rt, TALL, SHAPE, cells)
        assert np.abs(long.forward(x) - expected).max() <= 2 * BRICKS * expected.max()
        assert_near(long.adjoint(expected), back, BRICKS)


@pytest.mark.parametrize(("pixels", "tilt", "axis"), [
    ((13, 18), 0.0, ""), ((13, 18), 0.05, ""), ((700, 7), 0.0, ""), ((13, 18), 0.0, "rows"),
    ((13, 18), 0.0, "columns"),
], ids=["upright", "tilted", "blocks along z", "rows", "columns"])  # fmt: skip
def test_backprojection(two_rt, make_geometry, pixels, tilt, axis) -> None:
    """Of frames, and of lines that have poses of their own. Frames that are on the device give the same bits; only poses and
    weights go up."""
    grid, rng, count = Grid((11, 9, 19), (0.12, 0.2, 0.1)), np.random.default_rng(94), 9 if axis else 67
    views, weight = rng.uniform(-1, 1, (count, *pixels)).astype(np.float32), rng.uniform(0.5, 1, count)
    angles = rng.uniform(0, 6, (count, 1)) + np.linspace(-0.1, 0.1, pixels[axis == "columns"])
    poses = make_geometry(*pixels, offset=(0.1, 0.2)).pose(angles.ravel()).reshape(*angles.shape, 12)
    poses[..., 9:12] += tilt * poses[..., 6:9]
    image_bytes = 4 * (pixels[0] + 32) * 64 if pixels[0] < 100 else 4 * 32 * 800
    room = (9_000, 14_000) if axis else (12_000 + image_bytes, 9_000 + 4 * image_bytes)
    seen = (poses, weight, grid, axis) if axis else (poses[:, 0], weight, grid)
    project = backproject_lines if axis else backproject
    expected = project(two_rt, views, *seen)
    assert np.count_nonzero(expected) > 100
    for nbytes in room:
        with room_for(two_rt, nbytes):
            np.testing.assert_array_equal(project(two_rt, views, *seen), expected)
    on_device, numbers = two_rt.upload(views), count * (12 * angles.shape[1] + 1) if axis else count * 13
    for nbytes in (10**7, 40_000 + room[0]):
        with room_for(two_rt, nbytes):
            before = replace(two_rt.traffic)
            volume = project(two_rt, on_device, *seen)
            assert two_rt.traffic.bytes_down == before.bytes_down
            assert two_rt.traffic.bytes_up - before.bytes_up <= 4 * numbers * 9
            np.testing.assert_array_equal(two_rt.download(volume), expected)
            del volume


def test_what_does_not_fit_at_all_is_said_of_the_memory_and_of_arrays_on_the_device(rt, make_cloud) -> None:
    grid = Grid.cube(32, 2.0)
    operator = RayOperator(rt, grid, SHAPE, tables("static", SHAPE))
    x = rt.zeros(grid.shape)
    assert_refused({
        "volume": lambda: operator.forward(rt.zeros((1, 2, 3))),
        "float32": lambda: operator.forward(rt.zeros(grid.shape, np.int32)), "shape": lambda: operator.forward(x, x),
        "out": lambda: operator.forward(x, np.zeros(operator.frames_shape, np.float32)),
    })  # fmt: skip
    with room_for(rt, 5_000):
        with pytest.raises(OutOfMemoryError, match="32×32×32 voxels.*--memory"):
            operator.adjoint(noise(operator.frames_shape, 97))
        with pytest.raises(OutOfMemoryError):
            voxelise(rt, make_cloud(300, 98), grid)


def warned(caplog: pytest.LogCaptureFixture) -> int:
    return sum("smaller bricks" in r.message for r in caplog.records if r.levelno == logging.WARNING)


def test_a_refused_buffer_is_asked_for_once_more_in_bricks(
    rt, make_cloud, make_geometry, monkeypatch, caplog
) -> None:
    """Free memory can be less than the device said."""
    cells = tables("static", SHAPE, frames=3)
    operator = RayOperator(rt, TALL, SHAPE, cells)
    x, y = noise(TALL.shape, 99), noise(operator.frames_shape, 100)
    pose = make_geometry(*SHAPE).pose(np.arange(3.0))
    cloud = make_cloud(30, 101)
    calls = {
        "forward": lambda: RayOperator(rt, TALL, SHAPE, cells).forward(x),
        "adjoint": lambda: RayOperator(rt, TALL, SHAPE, cells).adjoint(y),
        "fdk": lambda: backproject(rt, y, pose, np.ones(3), TALL), "voxels": lambda: voxelise(rt, cloud, TALL),
    }  # fmt: skip
    for call in calls.values():
        expected = call()
        caplog.clear()
        with room_for(rt, 2_000_000), monkeypatch.context() as patch:
            refuse_large(patch, rt, 50_000, times=1)
            found = call()
        assert warned(caplog) == 1
        assert_near(found, expected, BRICKS)
        with room_for(rt, 2_000_000), monkeypatch.context() as patch:
            refuse_large(patch, rt, 500, times=9)
            with pytest.raises(OutOfMemoryError, match="memory of a test"):
                call()


def test_lists_of_too_many_entries_are_made_for_smaller_bricks(rt, make_cloud, monkeypatch, caplog) -> None:
    """Three tiles of 2^30 entries each: the sum is past 2^31, and must not turn negative but stay at the largest int."""
    rows = make_cloud(200, 102)
    whole = Voxeliser(rt, TALL.shape)
    expected = whole.voxelise(rows, TALL)
    monkeypatch.setattr(binning, "_MOST_ENTRIES", int(rt.download(whole.lists.tile_offsets)[-1]))
    del whole
    with room_for(rt, 1_200_000):
        np.testing.assert_array_equal(voxelise(rt, rows, TALL), expected)
    assert warned(caplog) == 1
    starts = rt.upload(np.array([0, 2**30, 2**30, 2**30, 5]), np.int32)
    rt.launch(rt.kernel("binning", "bin_starts"), 1, np.int32(4), starts)
    largest = 2**31 - 1
    np.testing.assert_array_equal(rt.download(starts), [0, 2**30, largest, largest, largest])
