"""The package's exceptions: each names the culprit, what was found, what was expected and what to do.

One line of text comes out of ``str()``, so that the command line can print it as it is.
"""

from __future__ import annotations


class PhyradgsError(Exception):
    """Base of every error that this package raises on purpose.

    Args:
        culprit: what is wrong: an option, a file with its HDF5 path, a device.
        found: the value or state met there.
        expected: what would have been right.
        remedy: what the user can do about it, as an imperative.

    Attributes:
        exit_code: status that the command line ends with.
    """

    exit_code = 2

    def __init__(self, culprit: str, found: str = "", expected: str = "", remedy: str = "") -> None:
        super().__init__(culprit, found, expected, remedy)  # all four, so that pickling keeps them
        self.culprit = culprit
        self.found = found
        self.expected = expected
        self.remedy = remedy

    def __str__(self) -> str:
        found = f"found {self.found}" if self.found else ""
        expected = f"expected {self.expected}" if self.expected else ""
        details = "; ".join(part for part in (found, expected, self.remedy) if part)
        text = f"{self.culprit}: {details}" if details else self.culprit
        return " ".join(text.split())  # messages of other libraries bring line breaks along


class InputError(PhyradgsError):
    """A file, a dataset or an option is wrong."""


class OutputError(PhyradgsError):
    """A result cannot be written."""


class DeviceError(PhyradgsError):
    """There is no such OpenCL device, or it fails."""


class NumericalError(PhyradgsError):
    """NaN or infinity arose in a computation."""

    exit_code = 3
