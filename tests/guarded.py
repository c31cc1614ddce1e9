"""Every buffer between two guards: a kernel that writes there fails the test that launched it.

For what Oclgrind cannot see, as it interprets kernels: what a driver's compiler makes of them.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyopencl as cl

from phyradgs_cl.runtime import DeviceArray, Runtime, context

_GUARD_BYTES, _ALIGNED_BYTES, _PATTERN = 4096, 128, 0xAB


class _Guarding:
    """pyopencl, whose buffers are parts of larger ones."""

    def __init__(self) -> None:
        self.wholes: dict[int, tuple[Any, int]] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(cl, name)

    def Buffer(self, of: Any, flags: int, nbytes: int) -> Any:  # noqa: N802 (pyopencl's name)
        room = -(-nbytes // _ALIGNED_BYTES) * _ALIGNED_BYTES
        whole = cl.Buffer(of, flags, room + 2 * _GUARD_BYTES)
        part = whole.get_sub_region(_GUARD_BYTES, nbytes)
        self.wholes[part.int_ptr] = whole, nbytes
        return part


def guard(set_to: Callable[[object, str, object], None] = setattr) -> None:
    """From here on every Runtime of this process checks its launches, of buffers that are made from here on."""
    guarding, launch = _Guarding(), Runtime.launch
    set_to(context, "cl", guarding)

    def checked(self: Runtime, kernel: Any, items: Any, *args: Any, **given: Any) -> None:
        found = [guarding.wholes.get(a.buffer.int_ptr) for a in args if isinstance(a, DeviceArray)]
        ours = [of for of in found if of is not None and of[0].context == self.context]
        for whole, nbytes in ours:
            for start, count in _guards(whole, nbytes):
                cl.enqueue_copy(self.queue, whole, np.full(count, _PATTERN, np.uint8), dst_offset=start)
        launch(self, kernel, items, *args, **given)
        for whole, nbytes in ours:
            for start, count in _guards(whole, nbytes):
                seen = np.empty(count, np.uint8)
                cl.enqueue_copy(self.queue, seen, whole, src_offset=start)
                assert (seen == _PATTERN).all(), f"{kernel.function_name} writes beyond its {nbytes} bytes"

    set_to(Runtime, "launch", checked)


def _guards(whole: Any, nbytes: int) -> tuple[tuple[int, int], ...]:
    """Where the guards of a buffer begin, and how long they are."""
    after = _GUARD_BYTES + nbytes
    return (0, _GUARD_BYTES), (after, whole.size - after)
