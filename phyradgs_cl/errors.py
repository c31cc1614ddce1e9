"""The package's exceptions. Each message is one line: subject, found value, expected value, remedy.

Scripts distinguish exit statuses (docs/trouble.md). Status 1 is Python's own, for a defect of this program."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

from phyradgs_cl.text import plain_text

_OPTION = re.compile(r"(?<!\w)'[^']*'|--set |(?<![\w-])--([a-z][a-z-]*)")  # quoted text matches whole, and stays
_STATES = ("given ", "not ")  # begin a state of the subject, which reads without "found"
_OTHER_NAMES = {"with": "others", "readout": "readout_axis", "air-mm": "air", "water-mm": "water", "hu": "hounsfield"}
"""By option, without dashes: the argument in Python, where it has another name."""


class PhyradgsError(Exception):
    """Base of every error that this package raises on purpose.

    subject: an option, a file with its HDF5 path, a device. found: the wrong value or state. expected: a right one.
    remedy: an imperative. ``exit_code``: the command line's exit status."""

    exit_code = 2

    def __init__(self, subject: str, found: str = "", expected: str = "", remedy: str = "") -> None:
        super().__init__(subject, found, expected, remedy)  # all four, so that pickling keeps them
        self.subject = subject
        self.found = found
        self.expected = expected
        self.remedy = remedy

    def __str__(self) -> str:
        found = f"found {self.found}" if self.found and not self.found.startswith(_STATES) else self.found
        expected = f"expected {self.expected}" if self.expected else ""
        details = "; ".join(part for part in (found, expected, self.remedy) if part)
        text = f"{self.subject}: {details}" if details else self.subject
        return plain_text(" ".join(text.split()))  # messages of other libraries contain line breaks


class InputError(PhyradgsError):
    """Raised for a wrong file, dataset or option."""


class NumericalError(PhyradgsError):
    """Raised where numbers of an iteration are no longer finite."""

    exit_code = 3


class OutputError(PhyradgsError):
    """Raised where a result cannot be written: no room, no permission, or another run writes it."""

    exit_code = 4


class DeviceError(PhyradgsError):
    """Raised where there is no OpenCL device, it fails, or a kernel does not build on it."""

    exit_code = 5


class NoSuchDeviceError(InputError, DeviceError):
    """Raised where the named device does not exist, which is a wrong option."""

    exit_code = 2


class OutOfMemoryError(DeviceError):
    """Raised where the memory of the device or of the machine is exhausted."""

    exit_code = 6


@contextmanager
def naming_arguments() -> Iterator[None]:
    """Makes errors of the body name Python's arguments instead of options: ``time_error`` instead of ``--time-error``."""
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
