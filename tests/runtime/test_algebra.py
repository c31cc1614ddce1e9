"""Algebra on the device against its twin on the host, in every shape of a launch; sums to float64, same bits every time."""

import gc

import numpy as np
import pytest
from tolerances import FLOAT32, SUMS

from phyradgs_cl.runtime import DeviceSpace, HostSpace, Runtime

HOST = HostSpace()
SHAPES = [(1,), (7, 5), (3, 11, 37), (40, 33, 35)]


def operands(shape: tuple[int, ...]) -> list[np.ndarray]:
    rng = np.random.default_rng(5)
    return [rng.normal(size=shape).astype(np.float32) for _ in range(3)]


@pytest.mark.parametrize("shape", SHAPES)
def test_elementwise_functions_are_their_twins(any_rt, shape) -> None:
    space, values = DeviceSpace(any_rt), operands(shape)
    on_device = [space.array(v) for v in values]
    for name, call in {
        "add": lambda s, x, y, z: s.add(x, y, -0.7),
        "add, clipped": lambda s, x, y, z: s.add(x, y, nonnegative=True),
        "extrapolate": lambda s, x, y, z: s.extrapolate(x, y, 0.3),
        "add_product": lambda s, x, y, z: s.add_product(x, y, z, 0.3),
        "add_product, clipped": lambda s, x, y, z: s.add_product(x, y, z, nonnegative=True),
        "multiply": lambda s, x, y, z: s.multiply(x, y),
        "reciprocal": lambda s, x, y, z: s.reciprocal(x, 0.1),
        "full": lambda s, x, y, z: s.full(shape, 1.5),
        "take": lambda s, x, y, z: s.take(x, [shape[0] - 1, 0]),
    }.items():
        found, expected = space.numpy(call(space, *on_device)), call(HOST, *values)
        np.testing.assert_allclose(found, expected, rtol=FLOAT32, atol=FLOAT32, err_msg=name)
    for before, after in zip(values, on_device, strict=True):
        np.testing.assert_array_equal(space.numpy(after), before)


@pytest.mark.parametrize("shape", SHAPES)
def test_numbers_are_their_twins(two_rt, shape) -> None:
    space, (x, y, z) = DeviceSpace(two_rt), operands(shape)
    a, b = space.array(x), space.array(y)
    steps = HOST.norm(x - y) * HOST.norm(y - z)
    assert abs(space.turn(a, b, space.array(z)) - HOST.turn(x, y, z)) <= SUMS * steps
    scale = HOST.norm(x) * HOST.norm(y)
    assert abs(space.inner(a, b) - HOST.inner(x, y)) <= SUMS * scale
    assert space.norm(a) == pytest.approx(HOST.norm(x), rel=SUMS)
    between = (v for v in (a, b, a) if space.inner(a, b) is not None)  # other sums on the way
    assert space.sum_squares(between) == pytest.approx(HOST.sum_squares([x, y, x]), rel=SUMS)
    assert space.sum_squares([]) == HOST.sum_squares([]) == 0
    assert space.largest(a) == HOST.largest(x)
    assert space.largest(a, absolute=True) == HOST.largest(x, absolute=True)
    assert [space.inner(a, b) for _ in range(3)] == [space.inner(a, b)] * 3


def test_sums_keep_what_float32_would_lose(any_rt) -> None:
    values = np.full(3_000_001, 1e-3, np.float32)
    values[::1000] = 1e3
    space = DeviceSpace(any_rt)
    expected = float(np.sum(values.astype(np.float64) ** 2))
    assert space.norm(space.array(values)) ** 2 == pytest.approx(expected, rel=SUMS)


def test_a_step_of_a_length_that_the_device_knows_and_last_axes_that_are_repeated(two_rt) -> None:
    space, (x, y, _) = DeviceSpace(two_rt), operands((5, 6, 7))
    found = space.multiply(space.array(x), space.array(y[0]))
    np.testing.assert_array_equal(space.numpy(found), x * y[0])
    found = space.numpy(space.descend(space.array(x), space.array(y), 0.25))
    np.testing.assert_allclose(found, x - 0.25 * y / HOST.norm(y), rtol=0, atol=FLOAT32)
    np.testing.assert_array_equal(space.numpy(space.descend(space.array(x), space.full(x.shape, 0), 0.25)), x)


def test_memory_is_used_again_and_given_back() -> None:
    rt = Runtime()
    space = DeviceSpace(rt)
    x = space.full((64, 64), 1.0)
    for _ in range(10):
        x = space.add(x, x)
    held = rt.ledger.held_bytes
    x = space.add(x, x)
    assert rt.ledger.held_bytes == held < 4 * 4 * x.size
    assert space.largest(x) == 2.0**11
    del space, x
    gc.collect()
    assert rt.ledger.held_bytes == 0
