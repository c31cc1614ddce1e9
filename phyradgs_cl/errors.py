"""The package's exceptions: each names the subject, what was found, what was expected and what to do, in one line.

Exit statuses are told apart by scripts (docs/trouble.md); 1 is Python's own, for a defect of this program.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager

from phyradgs_cl.text import plain_text

_OPTION = re.compile(r"(?<!\w)'[^']*'|--set |(?<![\w-])--([a-z][a-z-]*)")  # what is quoted, a command or a value, stays
_ELSEWHERE = {"with": "others", "readout": "readout_axis"}  # options whose argument has another name


class PhyradgsError(Exception):
    """Base of every error that this package raises on purpose. subject: what is wrong: an option, a file with its HDF5
    path, a device; found: the value or state met there; expected: what would have been right; remedy: what to do about it,
    as an imperative. ``exit_code``: the command line's status."""

    exit_code = 2

    def __init__(self, subject: str, found: str = "", expected: str = "", remedy: str = "") -> None:
        super().__init__(subject, found, expected, remedy)  # all four, so that pickling keeps them
        self.subject = subject
        self.found = found
        self.expected = expected
        self.remedy = remedy

    def __str__(self) -> str:
        found = f"found {self.found}" if self.found else ""
        expected = f"expected {self.expected}" if self.expected else ""
        details = "; ".join(part for part in (found, expected, self.remedy) if part)
        text = f"{self.subject}: {details}" if details else self.subject
        return plain_text(" ".join(text.split()))  # messages of other libraries bring line breaks along


class InputError(PhyradgsError):
    """A file, a dataset or an option is wrong."""


class NumericalError(PhyradgsError):
    exit_code = 3


class OutputError(PhyradgsError):
    """A result cannot be written: no room, no permission, or another run is at work on it."""

    exit_code = 4


class DeviceError(PhyradgsError):
    """There is no OpenCL device, it fails, or a kernel does not build on it."""

    exit_code = 5


class NoSuchDeviceError(InputError, DeviceError):
    """The device that was asked for is not there: as wrong an option as any other."""

    exit_code = 2


class OutOfMemoryError(DeviceError):
    """The memory of the device or of the machine is exhausted."""

    exit_code = 6


@contextmanager
def naming_arguments() -> Iterator[None]:
    """Errors of the body name arguments of Python for options of the command line: ``time_error`` for ``--time-error``."""
    try:
        yield
    except PhyradgsError as error:
        told = error.subject, error.found, error.expected, error.remedy
        error.args = tuple(_OPTION.sub(_argument, text) for text in told)
        error.subject, error.found, error.expected, error.remedy = error.args
        raise


def _argument(match: re.Match[str]) -> str:
    option = match[1]
    if option is None:
        return "" if match[0] == "--set " else match[0]
    return _ELSEWHERE.get(option, option.replace("-", "_"))


@contextmanager
def naming_host_memory() -> Iterator[None]:
    """Python's and NumPy's MemoryError in the body comes out as OutOfMemoryError."""
    try:
        yield
    except MemoryError as error:
        found = f"too little ({error})" if str(error) else "too little"
        remedy = "use a smaller problem, or a machine with more"
        raise OutOfMemoryError("memory of this machine", found, "enough", remedy) from error
