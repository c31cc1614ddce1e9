"""The package's exceptions. Each message is one line: subject, value found, value expected, remedy.

Each kind of error has an exit status, which scripts can test (docs/trouble.md). Python itself exits with 1 after a bug."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

from phyradgs_cl.text import plain_text

# Finds options in messages. Quoted text matches as a whole and is not changed: in a command line options keep their dashes.
_OPTION = re.compile(r"(?<!\w)'[^']*'|--set |(?<![\w-])--([a-z][a-z-]*)")
_STATES = ("given ", "not ")  # beginnings of texts that read better without "found", as in "--bins: not a number"
_OTHER_NAMES = {"with": "others", "readout": "readout_axis", "air-mm": "air", "water-mm": "water", "hu": "hounsfield"}
"""Options of the command line, without dashes, whose argument in Python has another name."""


class PhyradgsError(Exception):
    """Base of every error that this package raises on purpose.

    subject: what is wrong, as an option, a file with its HDF5 path or a device. found: the wrong value or state. expected:
    what would be right. remedy: what to do, as an imperative. ``exit_code``: the command line's exit status."""

    exit_code = 2

    def __init__(self, subject: str, found: str = "", expected: str = "", remedy: str = "") -> None:
        super().__init__(subject, found, expected, remedy)  # pickling keeps only the arguments that Exception gets
        self.subject, self.found, self.expected, self.remedy = subject, found, expected, remedy

    def __str__(self) -> str:
        found = f"found {self.found}" if self.found and not self.found.startswith(_STATES) else self.found
        expected = f"expected {self.expected}" if self.expected else ""
        details = "; ".join(part for part in (found, expected, self.remedy) if part)
        text = f"{self.subject}: {details}" if details else self.subject
        return plain_text(" ".join(text.split()))  # messages of other libraries contain line breaks


class InputError(PhyradgsError):
    """Raised for a wrong file, dataset or option."""


class NumericalError(PhyradgsError):
    """Raised where an iteration has diverged: its values are NaN or infinite."""

    exit_code = 3


class OutputError(PhyradgsError):
    """Raised where a result cannot be written: the disk is full, permission is missing, or another run writes the file."""

    exit_code = 4


class DeviceError(PhyradgsError):
    """Raised where there is no OpenCL device, where a device fails, or where a kernel does not build on the device."""

    exit_code = 5


class NoSuchDeviceError(InputError, DeviceError):
    """Raised where the device that the user named does not exist. Its exit status is that of a wrong option."""

    exit_code = 2


class OutOfMemoryError(DeviceError):
    """Raised where the device or the machine has too little memory."""

    exit_code = 6


@contextmanager
def naming_arguments() -> Iterator[None]:
    """Makes errors raised in the body name Python's arguments, as ``time_error``, not options, as ``--time-error``."""
    try:
        yield
    except PhyradgsError as error:
        parts = error.subject, error.found, error.expected, error.remedy
        error.args = tuple(_OPTION.sub(_argument, text) for text in parts)
        error.subject, error.found, error.expected, error.remedy = error.args
        raise


def _argument(match: re.Match[str]) -> str:
    option = match[1]
    if option is None:
        return "" if match[0] == "--set " else match[0]
    return _OTHER_NAMES.get(option, option.replace("-", "_"))


@contextmanager
def naming_host_memory() -> Iterator[None]:
    """Turns a MemoryError of Python or NumPy in the body into an OutOfMemoryError."""
    try:
        yield
    except MemoryError as error:
        found = f"too little ({error})" if str(error) else "too little"
        remedy = "use a smaller problem, or a machine with more"
        raise OutOfMemoryError("memory of this machine", found, "enough", remedy) from error
