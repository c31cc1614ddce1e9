"""Operators between device arrays: what they do to NumPy's, bit for bit, and nothing crosses the bus."""

from dataclasses import astuple, replace

import numpy as np
import pytest
from memory_limits import room_for
from ray_tables import noise, tables
from refusals import assert_refused
from tolerances import RAYS

from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import IntensityOperator, RayOperator, backproject, backproject_lines

pytestmark = pytest.mark.slow

SHAPE = (7, 37)
TALL = Grid((21, 70, 37), (0.09, 0.03, 0.05), (0.05, 0.1, -0.1))
UPRIGHT = Grid((12, 17, 21), (0.1, 0.1, 0.1))
AXES = pytest.mark.parametrize("axis", ["rows", "columns"])


def on_device(rt, call, values: np.ndarray) -> np.ndarray:
    """What ``call`` makes of a device array, after its second call, which moves nothing."""
    x = rt.upload(values)
    out = call(x)
    before = astuple(rt.traffic)
    found = call(x)
    assert astuple(rt.traffic) == before
    into = call(x, out)
    assert into is out
    np.testing.assert_array_equal(rt.download(out), rt.download(found))
    np.testing.assert_array_equal(rt.download(x), values)
    return rt.download(found)


@pytest.mark.parametrize(
    ("motion", "grid", "axis"),
    [("static", UPRIGHT, "rows"), ("static", UPRIGHT, "columns"),
     ("per line", TALL, "columns"), ("micro-views", TALL, "rows")],
)
def test_rays(two_rt, motion, grid, axis) -> None:
    operator = RayOperator(two_rt, grid, SHAPE, tables(motion, SHAPE, axis, frames=4))
    for part in (operator, operator.subset([2, 0])):
        x, y = noise(grid.shape, 31), noise(part.frames_shape, 32)
        np.testing.assert_array_equal(on_device(two_rt, part.forward, x), part.forward(x))
        np.testing.assert_array_equal(on_device(two_rt, part.adjoint, y), part.adjoint(y))


@AXES
def test_the_intensity_model(two_rt, axis) -> None:
    cells = tables("per line", SHAPE, axis, frames=3)
    host, device = (IntensityOperator(two_rt, TALL, SHAPE, cells) for _ in range(2))
    x, d = 4 * noise(TALL.shape, 33), noise(TALL.shape, 34)
    for chosen in ([0, 1, 2], [2, 1]):
        on_host, there = host.subset(chosen), device.subset(chosen)
        y = noise(there.frames_shape, 35)
        for name, values in (("forward", d), ("expected", x), ("forward", d), ("adjoint", y)):
            expected = getattr(on_host, name)(values)
            found = on_device(two_rt, getattr(there, name), values)
            np.testing.assert_allclose(found, expected, rtol=0, atol=RAYS * np.abs(expected).max(), err_msg=name)
    swapped = there.forward(d), two_rt.download(on_host.forward(two_rt.upload(d)))  # each has stood at the other's kind
    np.testing.assert_allclose(*swapped, rtol=0, atol=RAYS * swapped[0].max())


def test_what_does_not_fit_is_said(rt) -> None:
    operator = RayOperator(rt, UPRIGHT, SHAPE, tables("static", SHAPE))
    x = rt.zeros(UPRIGHT.shape)
    assert_refused({
        "volume": lambda: operator.forward(rt.zeros((1, 2, 3))),
        "float32": lambda: operator.forward(rt.zeros(UPRIGHT.shape, np.int32)),
        "shape": lambda: operator.forward(x, x),
        "out": lambda: operator.forward(x, np.zeros(operator.frames_shape, np.float32)),
    })  # fmt: skip


@AXES
def test_backprojection(two_rt, make_geometry, axis) -> None:
    """Frames that are on the device give the same bits; only poses and weights go up."""
    grid, pixels, rng = Grid((11, 9, 19), (0.12, 0.2, 0.1)), (13, 18), np.random.default_rng(38)
    geometry, frames = make_geometry(*pixels), rng.uniform(-1, 1, (9, *pixels)).astype(np.float32)
    lines = pixels[axis == "columns"]
    angles = rng.uniform(0, 6, (9, 1)) + np.linspace(-0.1, 0.1, lines)
    poses = geometry.pose(angles.ravel()).reshape(9, lines, 12)
    tilted = poses[:, 0].copy()
    tilted[:, 9:12] += 0.05 * tilted[:, 6:9]
    views = two_rt.upload(frames)
    calls = {
        "lines": lambda y: backproject_lines(two_rt, y, poses, np.ones(9), grid, axis),
        "upright": lambda y: backproject(two_rt, y, poses[:, 0], np.ones(9), grid),
        "tilted": lambda y: backproject(two_rt, y, tilted, np.ones(9), grid),
    }
    for name, call in calls.items():
        expected = call(frames)
        for room in (10**7, 40_000):
            with room_for(two_rt, room):
                before = replace(two_rt.traffic)
                volume = call(views)
                assert two_rt.traffic.bytes_down == before.bytes_down
                assert two_rt.traffic.bytes_up - before.bytes_up <= 4 * 9 * (12 * lines + 1) * 9
                np.testing.assert_array_equal(two_rt.download(volume), expected, err_msg=name)
                del volume
