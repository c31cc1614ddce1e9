"""Ctrl-C (and SIGTERM, where ``signals`` has taken it over) that waits: for an iteration, for results, for a file.

What is kept is always whole. Signals that somebody wants ignored stay ignored, and they belong to the main thread:
elsewhere nothing here does anything.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from phyradgs_cl import signals

Handler = Callable[[int, FrameType | None], None]
_SAME_PRESS_S = 1.0  # wrappers (timeout, uv) pass on what the terminal has sent already


class InterruptedAfterwards(KeyboardInterrupt):
    """Ctrl-C that came during work which was finished all the same."""


class StopRequest:
    """Whether somebody has asked the run to stop; asked again later, it does not wait."""

    def __init__(self) -> None:
        self.is_set = False
        self._asked_s = 0.0
        self.before: dict[int, object] = {}

    def __call__(self, number: int, frame: FrameType | None) -> None:
        signals.note(number)
        if self.is_set and time.monotonic() - self._asked_s > _SAME_PRESS_S:
            before = self.before.get(number)
            if not callable(before):
                raise KeyboardInterrupt
            before(number, frame)
        elif not self.is_set:
            self.is_set, self._asked_s = True, time.monotonic()


class _Waiting:
    """Signals that came while nothing could be done about them."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def __call__(self, number: int, frame: FrameType | None) -> None:
        signals.note(number)
        self.asked.append(number)


_after_loops: list[_Waiting] = []
"""Of every open ``keep_finished_work``, the innermost last: what takes the signals once a loop is done."""


@contextmanager
def stop_on_interrupt() -> Iterator[StopRequest]:
    """While open, a signal sets the request instead of raising; a later second one is answered as before."""
    request = StopRequest()
    with _handled_by(request) as request.before:
        try:
            yield request
        finally:
            if _after_loops:
                waiting = _after_loops[-1]
                for number in request.before:
                    signals.handle(number, waiting)
                    request.before[number] = waiting
                if request.is_set:  # perhaps in the last iteration, which has nothing to stop
                    waiting.asked.append(signals.number)


@contextmanager
def keep_finished_work() -> Iterator[None]:
    """While open, signals wait from the end of the first loop on; then InterruptedAfterwards.

    So what a loop has made is measured and written, and before the loop a signal still acts at once.
    """
    if not _is_main_thread():
        yield
        return
    waiting = _Waiting()
    _after_loops.append(waiting)
    before = {number: signal.getsignal(number) for number in _held_signals()}
    try:
        yield
    finally:
        _after_loops.remove(waiting)
        for number, handler in before.items():
            _put_back(number, handler)
    if waiting.asked:
        raise InterruptedAfterwards


@contextmanager
def finish_despite_interrupt() -> Iterator[None]:
    """While open, signals wait, however often they come; then InterruptedAfterwards. For short work, as writing."""
    waiting = _Waiting()
    with _handled_by(waiting):
        yield
        if signals.farewell == signals.NOTHING:
            signals.say_at_the_end(signals.COMPLETE)
    if waiting.asked:
        raise InterruptedAfterwards


@contextmanager
def _handled_by(handler: Handler) -> Iterator[dict[int, object]]:
    """``handler`` for the signals that are held; yields the handlers that are put back at the end."""
    before: dict[int, object] = {}
    try:
        if _is_main_thread():
            for number in _held_signals():
                before[number] = signals.handle(number, handler)
        yield before
    finally:
        for number, old in before.items():
            _put_back(number, old)


def _put_back(number: int, handler: object) -> None:
    """One of ours, or somebody else's as it was set."""
    ours = handler is signals.stop_at_once or isinstance(handler, (StopRequest, _Waiting))
    (signals.handle if ours else signal.signal)(number, handler)  # type: ignore[arg-type]


def _held_signals() -> list[int]:
    """SIGINT unless it is ignored, and SIGTERM where a command's process, or one of these, answers it."""
    held = [] if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else [int(signal.SIGINT)]
    answers = signal.getsignal(signal.SIGTERM)
    if answers is signals.stop_at_once or isinstance(answers, (StopRequest, _Waiting)):
        held.append(int(signal.SIGTERM))
    return held


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
