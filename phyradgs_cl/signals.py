"""Ctrl-C and SIGTERM in a process of the command line: one line on stderr and an end, whatever is running.

An exception from a signal's handler may surface in any library. So nothing is raised: the process removes its
half-written files and ends. Work worth keeping makes signals wait (reconstructors/interrupt.py). Nothing that takes
time is imported, nor ``signal``, which builds enums round ``_signal``: this is to be in force as early as can be.
"""

import _signal as signal
import os
import sys
import time

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType

NOTHING = "interrupted, nothing written"
COMPLETE = "interrupted, the output is complete"

farewell = NOTHING
"""What the line will say: whoever gets further than nothing says so here."""
number = int(signal.SIGINT)
"""The last signal that came."""
unfinished: set[str] = set()
"""Temporary files and folders that nobody will miss."""
patience_s: list[float] = []
"""Of every open block of interrupt.py: for how long signals wait after the first; below 0: not at all."""
asked_s: float | None = None
"""When the first of the signals that wait came."""
_taken: set[int] = set()


class InterruptedAfterwards(KeyboardInterrupt):
    """Ctrl-C that came during work which was finished all the same."""


def answer(caught: int, frame: "FrameType | None") -> None:
    """The handler: notes a signal that has to wait; else ends this process, or raises where it is not the command line's."""
    global number, asked_s
    number, now_s = caught, time.monotonic()
    if max(patience_s, default=-1) >= now_s - (now_s if asked_s is None else asked_s):
        asked_s = now_s if asked_s is None else asked_s
    elif caught in _taken:
        _end(caught)
    else:
        raise KeyboardInterrupt


def _end(caught: int) -> None:
    for path in tuple(unfinished):
        remove(path)
    try:
        if sys.stderr is not None:
            start = "\r\x1b[K" if sys.stderr.isatty() else ""  # over a counter that is open
            os.write(2, f"{start}phyradgs: {farewell}\n".encode())
    finally:  # whatever stderr is
        os._exit(128 + caught)


def remove(path: str) -> None:
    """Removes a temporary file or folder, if there is one."""
    try:
        os.unlink(path)
    except OSError:  # a folder, or there is none yet, or it has become the output
        import shutil

        shutil.rmtree(path, ignore_errors=True)


def handle(caught: int) -> None:
    """Sets the handler. System calls go on after it: a compiler inside a driver would take a short reading for an error."""
    signal.signal(caught, answer)
    if hasattr(signal, "siginterrupt"):
        signal.siginterrupt(caught, False)


def take_over() -> None:
    """From now on both signals stop this process; those that somebody wants ignored stay ignored."""
    for caught, usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGTERM, signal.SIG_DFL)):
        if signal.getsignal(caught) is usual:
            handle(caught)
            _taken.add(int(caught))


def let_go() -> None:
    """All is done and said: the interpreter's own end would answer with a traceback, or die without a word."""
    while _taken:
        signal.signal(_taken.pop(), signal.SIG_IGN)


def start_afresh() -> None:
    """Before a command: nothing is written yet, and nobody has asked to stop."""
    global farewell, number
    farewell, number = NOTHING, int(signal.SIGINT)


def say_at_the_end(text: str) -> None:
    global farewell
    farewell = text


def status() -> int:
    """The exit status of a command that was stopped: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + number
