"""Ctrl-C and SIGTERM: one flag that both set. The first signal raises KeyboardInterrupt, except in a loop, and where a
result is written: there it waits. A second press always raises. The flag is installed while the outermost block is open, and
nothing is kept in the module. Signals belong to the main thread; in other threads the blocks do nothing. A signal that
the user has set to be ignored stays ignored."""

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
_SAME_PRESS_S = 1.0  # wrappers (timeout, uv) send again what the terminal has sent already


class InterruptedAfterwards(KeyboardInterrupt):
    """A signal came during work that has been finished all the same."""


class StopFlag:
    """The handler of both signals. waits: whether the first one waits; keeps: whether it waits also after a loop. farewell:
    what the command line says where a signal has ended it."""

    def __init__(self) -> None:
        self.waits = self.keeps = False
        self.first_s: float | None = None
        self.number = int(signal.SIGINT)
        self.farewell = NOTHING

    @property
    def is_set(self) -> bool:
        """True once a signal has come."""
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
    """Installs the flag, and yields the one that is there already. takes_default: for SIGTERM, which otherwise ends the
    process as it always does."""
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
def stop_on_interrupt() -> Iterator[StopFlag]:
    """For a loop: the first signal sets ``is_set``."""
    with _waiting() as flag:
        yield flag


@contextmanager
def keep_finished_work() -> Iterator[None]:
    """For a loop and the writing of its result: signals wait from the end of the first loop in the body on. A signal that
    has waited becomes InterruptedAfterwards at the end."""
    with _waiting(waits=False) as flag:
        keeps, flag.keeps = flag.keeps, True
        try:
            yield
        finally:
            flag.keeps = keeps
    _raise_what_waited(flag)


@contextmanager
def finish_despite_interrupt() -> Iterator[None]:
    """For short work such as writing: a signal waits, then becomes InterruptedAfterwards."""
    with _waiting() as flag:
        yield
    flag.farewell = COMPLETE
    _raise_what_waited(flag)


def exit_status() -> int:
    """Returns the exit status of a stopped command: 130 after Ctrl-C, 143 after SIGTERM."""
    flag = _installed()
    return 128 + (int(signal.SIGINT) if flag is None else flag.number)


def farewell() -> str:
    """Returns what the command line says where a signal ends the present command."""
    flag = _installed()
    return NOTHING if flag is None else flag.farewell


@contextmanager
def _waiting(waits: bool = True) -> Iterator[StopFlag]:
    """Makes the first signal wait in the body; if not ``waits``, as it does around it.

    A device that fails after a signal has only lost its compiler, which gets the signal too: that is KeyboardInterrupt."""
    with answer_signals(takes_default=False) as flag:
        before, flag.waits = flag.waits, flag.waits or waits
        try:
            yield flag
        except DeviceError as error:
            if not flag.is_set:
                raise
            raise KeyboardInterrupt from error
        finally:
            flag.waits = before or (flag.keeps and flag.waits)  # the block around a loop keeps its work


def _installed() -> StopFlag | None:
    return next((h for h in map(signal.getsignal, _SIGNALS) if isinstance(h, StopFlag)), None)


def _raise_what_waited(flag: StopFlag) -> None:
    """Raises InterruptedAfterwards at the end of the outermost block that has made a signal wait."""
    if flag.is_set and not flag.waits:
        flag.farewell = COMPLETE
        raise InterruptedAfterwards
