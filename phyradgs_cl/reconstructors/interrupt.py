"""Ctrl-C that waits for the iteration under way: the state that is kept is always a whole one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class StopRequest:
    """Whether somebody has asked the run to stop."""

    def __init__(self) -> None:
        self.is_set = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self.is_set:  # asked twice: do not wait
            raise KeyboardInterrupt
        self.is_set = True


@contextmanager
def stop_on_interrupt() -> Iterator[StopRequest]:
    """While open, SIGINT sets the request instead of raising; a second one raises KeyboardInterrupt.

    Signals belong to the main thread; elsewhere the request is never set.
    """
    request = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield request
        return
    before = signal.signal(signal.SIGINT, request)
    try:
        yield request
    finally:
        signal.signal(signal.SIGINT, before)


class InterruptedAfterwards(KeyboardInterrupt):
    """Ctrl-C that came during work which was finished all the same."""


@contextmanager
def finish_despite_interrupt() -> Iterator[None]:
    """While open, SIGINT waits, however often it comes; then InterruptedAfterwards. For short work, as writing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: asked.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if asked and before is not signal.SIG_IGN:
        raise InterruptedAfterwards
