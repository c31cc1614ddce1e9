"""A tiny scan, the command line, and devices, memories and disks that fail when they are told to."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.io import checkpoint_path, read_volume

TINY = ["--phantom", "jaw", "--size", "10", "--detector", "12", "--views", "4", "--time-samples", "2"]
OLD = b"an older result"
Run = Callable[..., int]


@pytest.fixture(scope="session")
def run() -> Run:
    """The command line in this process: (arguments...) → exit status."""
    cli = load_cli()
    return lambda *arguments: cli.run([str(a) for a in arguments])


@pytest.fixture(scope="session")
def scan(run, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "scan.h5"
    assert run("simulate", *TINY, "-o", path) == 0
    return path


def cl_error(code: int) -> cl.Error:
    """An error as a driver's call raises it: -4 to -6 are memory, -36 and others a lost device."""
    kind = cl.MemoryError if code == -4 else cl.RuntimeError
    return kind(cl._cl._ErrorRecord("injected", code, "clEnqueueNDRangeKernel"))  # type: ignore[attr-defined]


class FailingCall:
    """A function of pyopencl that fails at call number ``at`` and, if ``for_good``, ever after; it counts the calls."""

    def __init__(self, function: Callable[..., object]) -> None:
        self.function, self.calls = function, 0
        self.at: int | None = None
        self.code, self.for_good = -36, True

    def arm(self, at: int | None, code: int = -36) -> None:
        """From now on fails at call ``at`` (from 1), or never."""
        self.calls, self.at, self.code = 0, at, code

    def __call__(self, *arguments: object, **options: object) -> object:
        self.calls += 1
        if self.at is not None and self.calls >= self.at:
            raise cl_error(self.code)
        return self.function(*arguments, **options)


@pytest.fixture
def launches(monkeypatch) -> FailingCall:
    """All launches of kernels of all runtimes."""
    call = FailingCall(cl.enqueue_nd_range_kernel)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", call)
    return call


@pytest.fixture
def copies(monkeypatch) -> FailingCall:
    """All blocking copies: what waits for the kernels before them, and is told late of what went wrong."""
    call = FailingCall(cl.enqueue_copy)
    monkeypatch.setattr(cl, "enqueue_copy", call)
    return call


def same_bits(one: Path, other: Path) -> None:
    """Volumes and records of two runs agree to the bit."""
    first, second = read_volume(one), read_volume(other)
    np.testing.assert_array_equal(first.volume, second.volume)
    assert [line["iteration"] for line in first.provenance["record"]] == [  # type: ignore[union-attr]
        line["iteration"]
        for line in second.provenance["record"]  # type: ignore[union-attr]
    ]
    if first.gaussians is not None:
        np.testing.assert_array_equal(first.gaussians.rows(), second.gaussians.rows())


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def resume_if_kept(output: Path) -> list[str]:
    return ["--resume"] if checkpoint_path(output).exists() else []
