"""A tiny scan, the command line, and devices, memories and disks that fail when they are told to."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from phyradgs_cl.io import checkpoint_path, read_volume

TINY = ["--phantom", "jaw", "--size", "10", "--detector", "12", "--views", "4", "--time-samples", "2"]
OLD = b"an older result"
Run = Callable[..., int]
fill = cl.enqueue_fill_buffer


@pytest.fixture(scope="session")
def run(cli) -> Run:
    """The command line in this process: (arguments...) → exit status."""
    return lambda *arguments: cli.run([str(a) for a in arguments])


@pytest.fixture(scope="session")
def scan(simulated) -> Path:
    return simulated(*TINY)


def cl_error(code: int) -> cl.Error:
    """An error as a driver's call raises it: -4 to -6 are memory, -36 and others a lost device."""
    kind = cl.MemoryError if code == -4 else cl.RuntimeError
    return kind(cl._cl._ErrorRecord("injected", code, "clEnqueueNDRangeKernel"))  # type: ignore[attr-defined]


class FailingCall:
    """A function of pyopencl that fails at call number ``at`` and ever after; it counts the calls."""

    def __init__(self, function: Callable[..., object]) -> None:
        self.function, self.calls, self.code = function, 0, -36
        self.at: int | None = None

    def arm(self, at: int | None, code: int = -36) -> None:
        """From now on fails at call ``at`` (from 1), or never."""
        self.calls, self.at, self.code = 0, at, code

    def __call__(self, *arguments: object, **options: object) -> object:
        if options.get("is_blocking") is False:  # how often nobody waits is a matter of time
            return self.function(*arguments, **options)
        self.calls += 1
        if self.at is not None and self.calls >= self.at:
            raise cl_error(self.code)
        return self.function(*arguments, **options)


def failing(monkeypatch, name: str) -> FailingCall:
    call = FailingCall(getattr(cl, name))
    monkeypatch.setattr(cl, name, call)
    return call


@pytest.fixture
def launches(monkeypatch) -> FailingCall:
    """All launches of kernels of all runtimes."""
    return failing(monkeypatch, "enqueue_nd_range_kernel")


@pytest.fixture
def copies(monkeypatch) -> FailingCall:
    """All blocking copies: what waits for the kernels before them, and is told late of what went wrong."""
    return failing(monkeypatch, "enqueue_copy")


def same_bits(one: Path, other: Path) -> None:
    """Volumes and records of two runs agree to the bit."""
    first, second = read_volume(one), read_volume(other)
    np.testing.assert_array_equal(first.values, second.values)
    told = [[line["iteration"] for line in stored.provenance["record"]] for stored in (first, second)]
    assert told[0] == told[1]
    if first.gaussians is not None:
        np.testing.assert_array_equal(first.gaussians.rows(), second.gaussians.rows())


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def resume_if_kept(output: Path) -> list[str]:
    return ["--resume"] if checkpoint_path(output).exists() else []
