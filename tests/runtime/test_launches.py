"""Launches on devices that allow less than PoCL does: groups by the kernel's own limit."""

import numpy as np
import pytest

from phyradgs_cl.device_check import check_device
from phyradgs_cl.errors import DeviceError
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime import context as runtime_context

GPU = {"lanes": 1, "pixel_items": True}


@pytest.fixture
def parts(monkeypatch):
    """(kernel, work-items, group, first) of every launch from now on."""
    seen, launch = [], runtime_context.cl.enqueue_nd_range_kernel

    def noted(queue, kernel, items, group, first=None):
        seen.append((kernel.function_name, items, group, first))
        return launch(queue, kernel, items, group, first)

    monkeypatch.setattr(runtime_context.cl, "enqueue_nd_range_kernel", noted)
    return seen


def test_groups_keep_to_what_each_kernel_allows(monkeypatch, parts) -> None:
    """A kernel with many registers may allow fewer items than its device. Here every kernel does."""
    monkeypatch.setattr(Runtime, "_asked", lambda *_: 32)
    verdict = check_device(**GPU)
    assert verdict.failures == () and len(verdict.agreeing) > 60
    assert max(np.prod(group) for _, _, group, _ in parts) == 32


def test_a_kernel_that_allows_hardly_any_items_is_named(monkeypatch) -> None:
    rt = Runtime(**GPU)
    monkeypatch.setattr(Runtime, "_asked", lambda *_: 8)
    with pytest.raises(DeviceError, match="kernel multiply_add on .*at most 8 work-items; expected 32 or more"):
        rt.launch(rt.kernel("rates", "multiply_add"), 64, 3, 0.5, rt.zeros(64), group=64)
