"""The device of a worker's process: kernels are built once and stay, run after run."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from phyradgs_cl.runtime import Runtime

_runtimes: dict[str | None, Runtime] = {}
_alone = threading.Lock()


@contextmanager
def runtime_of_process(wish: str | None = None) -> Iterator[Runtime]:
    """This process's runtime for a device (None: ``PHYRADGS_DEVICE``'s), for one run at a time: threads of a worker
    would otherwise set the arguments of one kernel twice at once."""
    with _alone:
        if wish not in _runtimes:
            _runtimes[wish] = Runtime(wish)
        yield _runtimes[wish]


def forget_runtimes() -> None:
    """After a failure that the device may not have survived: the next run opens it anew."""
    _runtimes.clear()
