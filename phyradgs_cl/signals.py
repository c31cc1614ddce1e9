"""Ctrl-C and SIGTERM: they raise KeyboardInterrupt, except in blocks that finish their work first. Each block installs its
own handler for the time that it is open, so nothing is kept in the module. Signals belong to the main thread; in other
threads the blocks do nothing. A signal that the user has set to be ignored stays ignored."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from types import FrameType

from phyradgs_cl.errors import DeviceError

NOTHING = "interrupted, nothing written"
COMPLETE = "interrupted, the output is complete"
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SAME_PRESS_S = 1.0  # wrappers (timeout, uv) send again what the terminal has sent already


class InterruptedAfterwards(KeyboardInterrupt):
    """A signal came during work that has been finished all the same."""


class _Answer(Enum):
    RAISE = "raise KeyboardInterrupt"
    WAIT_ONCE = "wait; a second press raises"
    WAIT = "wait, however often it comes"


class SignalHandler:
    """Answers the signals of one block. is_edge: the block is a whole command. farewell: what the command line says where a
    signal has ended it."""

    def __init__(self, answer: _Answer) -> None:
        self.answer = answer
        self.around: SignalHandler | None = None
        self.keeps_finished_work = self.is_edge = False
        self.first_s: float | None = None
        self.number = int(signal.SIGINT)
        self.farewell = NOTHING

    @property
    def is_set(self) -> bool:
        """True once a signal has come."""
        return self.first_s is not None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        now_s, self.number = time.monotonic(), number
        is_first = self.first_s is None
        self.first_s = now_s if self.first_s is None else self.first_s
        waits = self.answer is _Answer.WAIT or (is_first and self.answer is _Answer.WAIT_ONCE)
        if waits or (not is_first and now_s - self.first_s <= _SAME_PRESS_S):
            return
        raise KeyboardInterrupt


@contextmanager
def answer_signals() -> Iterator[SignalHandler]:
    """Makes both signals raise KeyboardInterrupt in a command, and records which one came."""
    with _handling(_Answer.RAISE, takes_default=True) as handler:
        handler.is_edge = True
        yield handler


@contextmanager
def stop_on_interrupt() -> Iterator[SignalHandler]:
    """For a loop: the first signal sets ``is_set``; a second press raises KeyboardInterrupt."""
    with _handling(_Answer.WAIT_ONCE) as handler:
        try:
            yield handler
        finally:  # the blocks around the loop keep its work
            for outer in _enclosing(handler):
                if outer.keeps_finished_work:
                    outer.answer = _Answer.WAIT


@contextmanager
def keep_finished_work() -> Iterator[None]:
    """For a loop and the writing of its result: signals wait from the end of the first loop in the body on. A signal that
    has waited becomes InterruptedAfterwards at the end."""
    with _handling(_Answer.RAISE) as handler:
        handler.keeps_finished_work = True
        yield
    _raise_what_waited(handler)


@contextmanager
def finish_despite_interrupt() -> Iterator[None]:
    """For short work such as writing: signals wait, then become InterruptedAfterwards."""
    with _handling(_Answer.WAIT) as handler:
        yield
    for outer in _enclosing(handler):
        outer.farewell = COMPLETE
    _raise_what_waited(handler)


def exit_status() -> int:
    """Returns the exit status of a stopped command: 130 after Ctrl-C, 143 after SIGTERM."""
    handler = _installed()
    return 128 + (int(signal.SIGINT) if handler is None else handler.number)


def farewell() -> str:
    """Returns what the command line says where a signal ends the present command."""
    handler = _installed()
    return NOTHING if handler is None else [handler, *_enclosing(handler)][-1].farewell


@contextmanager
def _handling(answer: _Answer, takes_default: bool = False) -> Iterator[SignalHandler]:
    """Installs a handler; what it has heard passes to the handler around it. takes_default: for SIGTERM, which otherwise
    ends the process as it always does. A device that fails after a signal has only lost its compiler, which gets the signal
    too: that is KeyboardInterrupt."""
    handler = SignalHandler(answer)
    if threading.current_thread() is not threading.main_thread():
        yield handler
        return
    handler.around = _installed()
    if handler.around is not None:
        handler.first_s, handler.number = handler.around.first_s, handler.around.number
    replaced = {number: signal.getsignal(number) for number in _SIGNALS}
    left_alone = (signal.SIG_IGN, None) if takes_default else (signal.SIG_IGN, signal.SIG_DFL, None)
    replaced = {number: usual for number, usual in replaced.items() if usual not in left_alone}
    for number in replaced:
        signal.signal(number, handler)
        if hasattr(signal, "siginterrupt"):  # system calls continue: a compiler in a driver would see a short read
            signal.siginterrupt(number, False)
    try:
        yield handler
    except DeviceError as error:
        if not handler.is_set:
            raise
        raise KeyboardInterrupt from error
    finally:
        if handler.around is not None:
            handler.around.number = handler.number
            if not handler.around.is_edge:
                handler.around.first_s = handler.first_s
        for number, usual in replaced.items():
            signal.signal(number, usual)


def _installed() -> SignalHandler | None:
    return next((h for h in map(signal.getsignal, _SIGNALS) if isinstance(h, SignalHandler)), None)


def _enclosing(handler: SignalHandler) -> Iterator[SignalHandler]:
    while handler.around is not None:
        handler = handler.around
        yield handler


def _raise_what_waited(handler: SignalHandler) -> None:
    """Raises InterruptedAfterwards at the end of the outermost block that has made a signal wait."""
    if handler.is_set and (handler.around is None or handler.around.is_edge):
        raise InterruptedAfterwards
