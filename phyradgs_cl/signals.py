"""Handles Ctrl-C and SIGTERM by one flag that both set. The first signal raises KeyboardInterrupt, except in a loop of
iterations and while a result is written: there it waits. A second one, over a second later, always raises. The flag is
installed while the outermost block is open, and nothing is kept in the module. Signals belong to the main thread; in other
threads the blocks do nothing. A signal that the user has set to be ignored stays ignored."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from phyradgs_cl.errors import DeviceError

NOTHING = "interrupted, nothing written"
COMPLETE = "interrupted, the output is complete"
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SAME_PRESS_S = 1.0  # a signal within this time of the first counts as the same: wrappers (timeout, uv) send it again


class InterruptedAfterwards(KeyboardInterrupt):
    """Raised where a signal came during work that was nevertheless finished."""


class StopFlag:
    """Handles both signals. waits: the first signal only sets the flag. keeps: it waits also after the end of a loop.
    farewell: the command line's message when a signal has ended it."""

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
    """Installs a flag as the signals' handler and yields it, or yields the flag that is installed already. takes_default:
    also replaces a default handler, as SIGTERM's, which ends the process at once."""
    is_main = threading.current_thread() is threading.main_thread()
    installed, flag = _installed() if is_main else None, StopFlag()
    if installed is not None or not is_main:
        yield installed or flag
        return
    left_alone = (signal.SIG_IGN, None) if takes_default else (signal.SIG_IGN, signal.SIG_DFL, None)
    replaced = {n: usual for n in _SIGNALS if (usual := signal.getsignal(n)) not in left_alone}
    for number in replaced:
        signal.signal(number, flag)
        if hasattr(signal, "siginterrupt"):  # system calls continue: a compiler in a driver would see a short read
            signal.siginterrupt(number, False)
    try:
        yield flag
    finally:
        for number, usual in replaced.items():
            signal.signal(number, usual)


@contextmanager
def stop_on_interrupt(waits: bool = True) -> Iterator[StopFlag]:
    """Makes the first signal in the body, as a loop of iterations, wait: it only sets ``is_set`` of the flag that is
    yielded. With ``waits`` False it waits only where it waits around the body.

    A device that fails after a signal has only lost its compiler, which got the signal too: this raises
    KeyboardInterrupt."""
    with answer_signals(takes_default=False) as flag:
        before, flag.waits = flag.waits, flag.waits or waits
        try:
            yield flag
        except DeviceError as error:
            if not flag.is_set:
                raise
            raise KeyboardInterrupt from error
        finally:
            flag.waits = before or (flag.keeps and flag.waits)  # after a loop the block around it still keeps its result


@contextmanager
def keep_finished_work() -> Iterator[None]:
    """Makes signals wait from the first loop in the body to the end of the body, so that the loop's result is written.
    Then raises InterruptedAfterwards if a signal has waited."""
    with stop_on_interrupt(waits=False) as flag:
        keeps, flag.keeps = flag.keeps, True
        try:
            yield
        finally:
            flag.keeps = keeps
    _raise_what_waited(flag)


@contextmanager
def finish_despite_interrupt() -> Iterator[None]:
    """Makes a signal wait during short work such as writing. Then raises InterruptedAfterwards if one has waited."""
    with stop_on_interrupt() as flag:
        yield
    flag.farewell = COMPLETE
    _raise_what_waited(flag)


def exit_status() -> int:
    """Returns the exit status of a stopped command: 130 after Ctrl-C, 143 after SIGTERM."""
    flag = _installed()
    return 128 + (int(signal.SIGINT) if flag is None else flag.number)


def farewell() -> str:
    """Returns the message of the command line for a command that a signal has ended."""
    flag = _installed()
    return NOTHING if flag is None else flag.farewell


def _installed() -> StopFlag | None:
    return next((h for h in map(signal.getsignal, _SIGNALS) if isinstance(h, StopFlag)), None)


def _raise_what_waited(flag: StopFlag) -> None:
    """Raises InterruptedAfterwards at the end of the outermost block that has made a signal wait."""
    if flag.is_set and not flag.waits:
        flag.farewell = COMPLETE
        raise InterruptedAfterwards
