"""Little memory, and memory that is refused, for the tests of operators that work in bricks."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from phyradgs_cl.runtime import MemoryShortage, Runtime

PLANNED = 0.9  # share of free memory that is planned with


@contextmanager
def room_for(rt: Runtime, nbytes: int) -> Iterator[None]:
    """So much device memory and no more; that it was kept to is checked at the end. Plans take their share of it as where a
    driver says what is free."""
    gc.collect()  # what others have left would count as held
    ledger = rt.ledger
    before = ledger.limit_bytes, ledger.planned
    ledger.limit_bytes, ledger.planned = ledger.held_bytes + nbytes, PLANNED
    rt.reset_peak()
    try:
        yield
        assert ledger.peak_bytes <= ledger.limit_bytes
    finally:
        ledger.limit_bytes, ledger.planned = before


def refuse_large(monkeypatch: pytest.MonkeyPatch, rt: Runtime, floats: int, times: int) -> None:
    """The next ``times`` buffers of at least so many floats are refused, as by a driver with less than it said."""
    allocate, left = rt.empty, [times]

    def empty(shape: object, *args: object) -> object:
        made = allocate(shape, *args)  # type: ignore[arg-type]
        if made.size >= floats and left[0]:
            left[0] -= 1
            raise MemoryShortage("memory of a test", f"{made.nbytes} bytes", "less")
        return made

    monkeypatch.setattr(rt, "empty", empty)
