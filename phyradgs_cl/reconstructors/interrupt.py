"""Ctrl-C (and SIGTERM, where ``signals`` has taken it over) that waits: for an iteration, for results, for a file.

What is kept is always whole. Signals that somebody wants ignored stay ignored, and they belong to the main thread:
elsewhere nothing here does anything.
"""

import math
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from phyradgs_cl import signals
from phyradgs_cl.errors import DeviceError

_SAME_PRESS_S = 1.0  # wrappers (timeout, uv) pass on what the terminal has sent already


@dataclass(frozen=True)
class StopRequest:
    """Whether somebody has asked the run to stop."""

    is_heard: bool

    @property
    def is_set(self) -> bool:
        return self.is_heard and signals.asked_s is not None


@contextmanager
def stop_on_interrupt() -> Iterator[StopRequest]:
    """While open, a signal sets the request; a second one, later, does not wait. For a loop."""
    with _waiting(_SAME_PRESS_S) as is_heard:
        try:
            yield StopRequest(is_heard)
        finally:  # what the loop has made is to be kept by the blocks around it
            if is_heard:
                signals.patience_s[:-1] = [math.inf] * (len(signals.patience_s) - 1)


@contextmanager
def keep_finished_work() -> Iterator[None]:
    """While open, signals wait from the end of the first loop on; then InterruptedAfterwards.

    So what a loop has made is measured and written, and before the loop a signal still acts at once.
    """
    with _waiting(-1.0, says_so=True):
        yield


@contextmanager
def finish_despite_interrupt() -> Iterator[None]:
    """While open, signals wait, however often they come; then InterruptedAfterwards. For short work, as writing."""
    with _waiting(math.inf, says_so=True):
        yield
        if signals.farewell == signals.NOTHING:
            signals.say_at_the_end(signals.COMPLETE)


@contextmanager
def _waiting(patience_s: float, says_so: bool = False) -> Iterator[bool]:
    """While open, signals wait for so long; yields whether they do. The outermost block tells of them at its end.

    A device that fails then has only lost its compiler, which Ctrl-C reaches too: that is KeyboardInterrupt.
    """
    if threading.current_thread() is not threading.main_thread():
        yield False
        return
    before = signal.getsignal(signal.SIGINT)
    is_others = before is not signal.SIG_IGN and before is not signals.answer
    if is_others:
        signals.handle(signal.SIGINT)
    signals.patience_s.append(patience_s)
    asked = False
    try:
        yield True
    except DeviceError as error:
        if signals.asked_s is None:
            raise
        raise KeyboardInterrupt from error
    finally:
        signals.patience_s.pop()
        if is_others:
            signal.signal(signal.SIGINT, before)
        if not signals.patience_s:
            asked, signals.asked_s = signals.asked_s is not None, None
    if asked and says_so:
        raise signals.InterruptedAfterwards
