"""Ctrl-C and SIGTERM in a process of the command line: one line on stderr and an end, whatever is running.

An exception raised by a signal's handler may surface in any library, which may swallow it or complain about it. So
nothing is raised here: the process removes its half-written files and ends. Work that is worth keeping holds the signals
until it is saved (reconstructors/interrupt.py). Nothing is imported that takes time, not even ``signal``, which builds enums
round ``_signal``: this is to be in force as early as can be.
"""

from __future__ import annotations

import _signal as signal
import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

    Handler = Callable[[int, FrameType | None], None]

NOTHING = "interrupted, nothing written"
COMPLETE = "interrupted, the output is complete"

farewell = NOTHING
"""What the line will say: whoever gets further than nothing says so here."""
number = int(signal.SIGINT)
"""The last signal that was held."""
unfinished: set[str] = set()
"""Temporary files and folders that nobody will miss."""


def stop_at_once(caught: int, frame: FrameType | None) -> None:
    """The handler of a process of ours: says ``farewell`` and ends with 128 + the signal's number."""
    for path in tuple(unfinished):
        _remove(path)
    try:
        if sys.stderr is not None:
            start = "\r\x1b[K" if sys.stderr.isatty() else ""  # over a counter that is open
            os.write(2, f"{start}phyradgs: {farewell}\n".encode())
    finally:  # whatever stderr is
        os._exit(128 + caught)


def _remove(path: str) -> None:
    try:
        os.unlink(path)
    except OSError:  # a folder, or there is none yet, or it has become the output
        import shutil

        shutil.rmtree(path, ignore_errors=True)


def handle(caught: int, handler: Handler) -> object:
    """Sets a handler that returns, or ends the process; the handler before it.

    System calls go on after it: a compiler inside an OpenCL driver would take a reading that is cut short for an error.
    """
    before = signal.signal(caught, handler)
    if hasattr(signal, "siginterrupt"):
        signal.siginterrupt(caught, False)
    return before


def take_over() -> None:
    """From now on both signals stop this process at once; those that somebody wants ignored stay ignored."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        handle(signal.SIGINT, stop_at_once)
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        handle(signal.SIGTERM, stop_at_once)


def let_go() -> None:
    """Nothing is left to be interrupted: the interpreter's own end would answer Ctrl-C with a traceback."""
    for caught, after in ((signal.SIGINT, signal.SIG_IGN), (signal.SIGTERM, signal.SIG_DFL)):
        if signal.getsignal(caught) is stop_at_once:
            signal.signal(caught, after)


def start_afresh() -> None:
    """Before a command: nothing is written yet, and nobody has asked to stop."""
    global farewell, number
    farewell, number = NOTHING, int(signal.SIGINT)


def say_at_the_end(text: str) -> None:
    """Sets what the line will say."""
    global farewell
    farewell = text


def note(caught: int) -> None:
    """Remembers a signal that was held, for the exit status."""
    global number
    number = caught


def status() -> int:
    """The exit status of a command that was stopped: 130 after Ctrl-C, 143 after SIGTERM."""
    return 128 + number
