"""Handles Ctrl-C and SIGTERM so that a stopped run still writes its result.

The first signal raises KeyboardInterrupt. In a loop of iterations, and while a result is written, it only sets a flag, and
the exception comes later. A second signal, more than a second after the first, always raises. Python delivers signals to
the main thread, so the functions here do nothing in other threads. A signal that the user ignores stays ignored."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from phyradgs_cl.errors import DeviceError

NOTHING = "interrupted, nothing new written"
COMPLETE = "interrupted, the output is complete"
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SAME_PRESS_S = 1.0  # signals within this time of the first count as the first: wrappers such as timeout repeat a signal


class StopFlag:
    """The handler of SIGINT and SIGTERM. waits: the first signal is remembered, but raises nothing yet. keeps: ``waits``
    stays True after a loop of iterations, until the loop's result is written. farewell: what the command line prints after
    a signal has ended the command."""

    def __init__(self) -> None:
        self.waits = self.keeps = False
        self.first_s: float | None = None
        self.number = int(signal.SIGINT)
        self.farewell = NOTHING

    @property
    def is_set(self) -> bool:
        """Whether a signal has come."""
        return self.first_s is not None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        now_s, self.number = time.monotonic(), number
        if self.first_s is None:
            self.first_s = now_s
            if self.waits:
                return
        elif now_s - self.first_s <= _SAME_PRESS_S:
            return
        raise KeyboardInterrupt


@contextmanager
def answer_signals(*, takes_default: bool = True) -> Iterator[StopFlag]:
    """Installs a ``StopFlag`` as the handler of SIGINT and SIGTERM, and yields it. In such a block, yields the block's flag.

    takes_default: True also replaces the system's default action, which for SIGTERM ends the process at once."""
    is_main = threading.current_thread() is threading.main_thread()
    installed, flag = _installed() if is_main else None, StopFlag()
    if installed is not None or not is_main:
        yield installed or flag
        return
    left_alone = (signal.SIG_IGN, None) if takes_default else (signal.SIG_IGN, signal.SIG_DFL, None)
    replaced = {n: usual for n in _SIGNALS if (usual := signal.getsignal(n)) not in left_alone}
    for number in replaced:
        signal.signal(number, flag)
        if hasattr(signal, "siginterrupt"):  # without this call a signal interrupts reads, and a driver's compiler fails
            signal.siginterrupt(number, False)
    try:
        yield flag
    finally:
        for number, usual in replaced.items():
            signal.signal(number, usual)


@contextmanager
def stop_on_interrupt(waits: bool = True) -> Iterator[StopFlag]:
    """Yields a flag whose ``is_set`` tells a loop of iterations that a signal came; the first signal does not raise.

    waits: False leaves it to the surrounding block whether the first signal raises. A driver's compiler gets the signal too
    and may end early, so that the device fails. A DeviceError after a signal becomes KeyboardInterrupt."""
    with answer_signals(takes_default=False) as flag:
        before, flag.waits = flag.waits, flag.waits or waits
        try:
            yield flag
        except DeviceError as error:
            if not flag.is_set:
                raise
            raise KeyboardInterrupt from error
        finally:
            flag.waits = before or (flag.keeps and flag.waits)  # in ``keep_finished_work``, signals wait beyond the loop


@contextmanager
def keep_finished_work() -> Iterator[None]:
    """Delays signals from the first loop of iterations in the body to the end of the body, so that the loop's result is
    written. Then raises KeyboardInterrupt if a signal has come."""
    with stop_on_interrupt(waits=False) as flag:
        keeps, flag.keeps = flag.keeps, True
        try:
            yield
        finally:
            flag.keeps = keeps
    _raise_what_waited(flag)


@contextmanager
def finish_despite_interrupt() -> Iterator[None]:
    """Delays signals during short work such as writing. Then raises KeyboardInterrupt if a signal has come."""
    with stop_on_interrupt() as flag:
        yield
    flag.farewell = COMPLETE
    _raise_what_waited(flag)


def exit_status() -> int:
    """Returns the exit status of a stopped command: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + (_installed() or StopFlag()).number


def farewell() -> str:
    """Returns what the command line prints when a signal has ended a command."""
    return (_installed() or StopFlag()).farewell


def _installed() -> StopFlag | None:
    return next((h for h in map(signal.getsignal, _SIGNALS) if isinstance(h, StopFlag)), None)


def _raise_what_waited(flag: StopFlag) -> None:
    """Raises KeyboardInterrupt if a signal was delayed, unless an outer block still delays it."""
    if flag.is_set and not flag.waits:
        flag.farewell = COMPLETE
        raise KeyboardInterrupt
