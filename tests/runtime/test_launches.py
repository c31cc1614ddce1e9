"""Launches on devices that allow less than PoCL does: groups by the kernel's own limit, and no launch that takes long.

tests/test_device_check.py asks every kernel so."""

import math
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from kernel_kit import launches

from phyradgs_cl import operators
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import per_line_cells
from phyradgs_cl.errors import DeviceError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators.splats import binning
from phyradgs_cl.runtime import DeviceSpace, Runtime, context

GPU = {"lanes": 1, "pixel_items": True}


@pytest.fixture
def parts(monkeypatch):
    return launches(monkeypatch)


def test_a_kernel_that_allows_hardly_any_items_is_named(monkeypatch) -> None:
    rt = Runtime(**GPU)
    monkeypatch.setattr(Runtime, "_asked", lambda *_: 8)
    with pytest.raises(DeviceError, match="kernel multiply_add on .*at most 8 work-items; expected 32 or more"):
        rt.launch(rt.kernel("rates", "multiply_add"), 64, 3, 0.5, rt.zeros(64), group=64)


def test_threads_launch_the_same_kernel_with_their_own_arguments(rt, monkeypatch) -> None:
    """Each launch waits between its arguments and its start, so that another thread could set its own in between."""
    cut = context._parts
    monkeypatch.setattr(context, "_parts", lambda *given: time.sleep(0.001) or cut(*given))

    def is_right(number: float) -> bool:
        own, space = rt.upload(np.full(64, number, np.float32)), DeviceSpace(rt)
        return all(np.all(rt.download(space.add(own, own, 1.0)) == 2 * number) for _ in range(10))

    before = rt.ledger.held_bytes
    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(is_right, range(1, 5)))
    assert rt.ledger.held_bytes == before


@pytest.mark.parametrize(("shape", "sides"), [
    ((64, 5), (64, 1)), ((16, 16, 16), (16, 4, 1)), ((16, 6, 4), (16, 2, 2)), ((17, 4), (32, 2)),
    ((5, 3), (64, 1)), ((3,), (64,)),
])  # fmt: skip
def test_a_gpu_group_fills_other_axes_where_the_first_is_short(parts, shape, sides) -> None:
    rt = Runtime(**GPU)
    rt.launch(rt.kernel("rates", "multiply_add"), shape, 3, 0.5, rt.zeros(64), group=64)
    rt.launch(rt.kernel("rates", "multiply_add"), shape, 3, 0.5, rt.zeros(64), group=(64,))
    assert [group for *_, group, _ in parts] == [sides, (64, *([1] * (len(shape) - 1)))]
    assert all(count % size == 0 for _, items, group, _ in parts for count, size in zip(items, group, strict=True))


@pytest.mark.parametrize("most_samples", [10**4, 10])
def test_launches_below_a_frame_have_the_same_bits(monkeypatch, parts, most_samples) -> None:
    """Cells count: each of the lines has three, of their own."""
    rt, grid, shape = Runtime(**GPU), Grid((6, 7, 9), (0.2, 0.2, 0.2)), (10, 12)
    orbit = CircularOrbit(ConeGeometry(5.0, 7.5, shape, (0.3, 0.3)), ConstantSpeed(0.3, 0.5))
    tables = [per_line_cells(orbit, Shutter(0.8, 0.6), 0, start_s, shape[0], 3) for start_s in (0.2, 1.4)]
    rng = np.random.default_rng(1)
    x, y = (rng.uniform(size=size).astype(np.float32) for size in (grid.shape, (2, *shape)))
    operator = operators.RayOperator(rt, grid, shape, tables)
    whole = operator.forward(x), operator.adjoint(y)
    del parts[:]
    monkeypatch.setattr(Runtime, "most_samples", most_samples)
    np.testing.assert_array_equal(operator.forward(x), whole[0])
    np.testing.assert_array_equal(operator.adjoint(y), whole[1])
    for name, items, group, _ in parts:
        if name == "rays_forward":
            assert shape[1] * math.prod(items[1:]) * 9 * 3 <= most_samples or items == group


def test_a_gpu_waits_for_the_number_of_entries_where_a_launch_without_lists_would_be_long(monkeypatch) -> None:
    rt = Runtime(**GPU)
    lists, extents = binning.TileLists(rt, (16, 8, 1), (2, 2, 1)), rt.zeros((6, 16), np.int32)
    lists.build(extents, 10, 16)
    before = rt.traffic.blocking
    lists.build(extents, 10, 16, cells=3)
    assert rt.traffic.blocking == before
    monkeypatch.setattr(binning, "_MOST_CHECKS", 4 * 128 * 10 * 3 - 1)
    lists.build(extents, 10, 16, cells=3)
    assert rt.traffic.blocking == before + 1
