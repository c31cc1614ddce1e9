"""Launches on devices that allow less than PoCL does: groups by the kernel's own limit, and no launch that takes long.

tests/test_device_check.py asks every kernel so."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from kernel_kit import launches

from phyradgs_cl.errors import DeviceError
from phyradgs_cl.operators.splats import binning
from phyradgs_cl.runtime import DeviceSpace, Runtime, context

GPU = {"lanes": 1, "pixel_items": True}


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
def test_a_gpu_group_fills_other_axes_where_the_first_is_short(monkeypatch, shape, sides) -> None:
    rt, parts = Runtime(**GPU), launches(monkeypatch)
    rt.launch(rt.kernel("rates", "multiply_add"), shape, 3, 0.5, rt.zeros(64), group=64)
    rt.launch(rt.kernel("rates", "multiply_add"), shape, 3, 0.5, rt.zeros(64), group=(64,))
    assert [group for *_, group, _ in parts] == [sides, (64, *([1] * (len(shape) - 1)))]
    assert all(count % size == 0 for _, items, group, _ in parts for count, size in zip(items, group, strict=True))


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
