"""Shows a command's progress on stderr. A terminal or a notebook shows one line that changes; a file or a pipe gets a new
line every ten seconds."""

import sys
import time
from contextlib import suppress

import typer

from phyradgs_cl.reconstructors import Progress
from phyradgs_cl.text import clock

_OVER = "\r\x1b[K"  # moves the cursor of a terminal to the start of its line, and clears the line
_TERMINAL_EVERY_S = 0.2  # least time between two changes of the line on a terminal
_ELSEWHERE_EVERY_S = 10.0  # least time between two lines in a file or pipe


def has_reader() -> bool:
    """Returns whether stderr is a terminal or a notebook's cell, where a line can be rewritten."""
    return sys.stderr is not None and (sys.stderr.isatty() or _in_notebook())


def _in_notebook() -> bool:
    return type(sys.stderr).__module__.startswith("ipykernel")


class Ticker:
    """Shows how many ``noun``s, such as frames, are done, the rate and the time left. Leaving its context ends the line."""

    def __init__(self, noun: str) -> None:
        self.noun = noun
        self.is_terminal = has_reader()
        self._width = 0  # characters of the last line: a notebook cannot clear a line, so spaces must cover it
        self.started = self.last = time.monotonic()
        self.first: int | None = None
        self.first_share = 0.0
        self.is_open = self.is_counting = False

    def __enter__(self) -> "Ticker":
        return self

    def __exit__(self, *_: object) -> None:
        self.end_line()

    def end_line(self) -> None:
        """Ends the line that is being rewritten, if any. A line with a count stays; a line that names a stage is cleared."""
        if self.is_open:
            _write("" if self.is_counting else self._over(""), ends_line=self.is_counting)
        self.is_open = False

    def stage(self, text: str) -> None:
        """Replaces the line on a terminal by the name of the current stage. Elsewhere shows nothing."""
        if self.is_terminal:
            _write(self._over(text), ends_line=False)
            self.is_open, self.is_counting = True, False

    def end(self, text: str) -> None:
        """Replaces the line on a terminal by ``text``, which stays. Elsewhere shows nothing."""
        self.stage(text)
        self.is_counting = self.is_open

    def note(self, text: str) -> None:
        """Prints a line that stays; the progress continues in a new line below it."""
        _write(self._over(text) if self.is_open else text)
        self.is_open = self.is_counting = False

    def progress(self, p: Progress) -> None:
        cloud = f"  {p.gaussians} Gaussians" if p.gaussians else ""
        self.show(p.iteration, p.iterations, f"  {p.quantity} {p.loss:.5f}{cloud}")

    def show(self, done: int, total: int, more: str = "", share: float | None = None) -> None:
        """Shows ``done`` of ``total``, then ``more``: at the end, and if 0.2 s have passed since the last line (10 s outside
        of a terminal). share: the fraction of the work that is done, if it differs from done / total."""
        now = time.monotonic()
        if share is None:
            share = done / total if total else 0.0
        if self.first is None:
            self.first, self.started, self.first_share = done, now, share
        every_s = _TERMINAL_EVERY_S if self.is_terminal else _ELSEWHERE_EVERY_S
        if done < total and now - self.last < every_s:
            return
        self.last = now
        line = f"{self.noun} {done}/{total}{more}{self._rate(done, share, now)}"
        _write(self._over(line) if self.is_terminal else line, ends_line=not self.is_terminal)
        self.is_open = self.is_counting = self.is_terminal

    def _over(self, line: str) -> str:
        """Returns the text, with control characters, that replaces the unfinished line on the screen by ``line``."""
        if not _in_notebook():
            return f"{_OVER}{line}"
        before, self._width = self._width, len(line)
        return f"\r{line.ljust(before)}"

    def _rate(self, done: int, share: float, now: float) -> str:
        since_first, seconds = done - (self.first or 0), now - self.started
        if seconds <= 0 or since_first <= 0 or share <= self.first_share:
            return ""
        left_s = seconds * (1 - share) / (share - self.first_share)
        return f"  {since_first / seconds:.1f}/s  ETA {clock(left_s)}"


def _write(text: str, ends_line: bool = True) -> None:
    with suppress(OSError):  # a full disk or a closed pipe behind stderr must not stop a run
        typer.echo(text, err=True, nl=ends_line)
