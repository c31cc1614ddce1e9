"""A device that fails at any launch, memory that runs out: one line, outputs as they were, resumed runs as if whole."""

import subprocess
import sys

import faults_kit as kit
import numpy as np
import pytest
from stress import TIMES

from phyradgs_cl.io import checkpoint_path
from phyradgs_cl.runtime import context

pytestmark = pytest.mark.slow
# STRESS=50 is what `make stress` sets: there a hundred launches all over a run fail once each, or all where it has fewer
MOST = 2 * TIMES
RUNS = {
    "sirt": ["--method", "sirt", "--motion", "per-row", "--iterations", "5"],
    "phyradgs": ["--method", "phyradgs", "--iterations", "60", "--gaussians", "30", "--set", "control.start_iteration=20"],
}


def command(scan, output, options) -> list[object]:
    return ["reconstruct", scan, "-o", output, *options, "--checkpoint-every", "1e-6"]


@pytest.mark.parametrize("name", RUNS)
def test_a_device_that_fails_at_any_launch(run, scan, tmp_path, capfd, launches, name) -> None:
    whole, output = tmp_path / "whole.h5", tmp_path / "v.h5"
    launches.arm(None)
    assert run(*command(scan, whole, RUNS[name])) == 0
    kept = 0
    for at in np.unique(np.linspace(1, launches.calls, MOST).astype(int)).tolist():
        output.write_bytes(kit.OLD)
        capfd.readouterr()
        launches.arm(at)
        assert run(*command(scan, output, RUNS[name])) == 5
        line = capfd.readouterr().err.splitlines()[-1]
        assert all(words in line for words in ("phyradgs: device ", "a launch of", "INVALID_COMMAND_QUEUE"))
        assert output.read_bytes() == kit.OLD
        left = kit.names(tmp_path)
        assert left in (["v.h5", "whole.h5"], ["v.h5", "v.h5.checkpoint.npz", "whole.h5"])
        assert ("--resume continues from iteration" in line) == (len(left) == 3)
        kept += len(left) == 3
        launches.arm(None)
        assert run(*command(scan, output, RUNS[name]), *kit.resume_if_kept(output)) == 0
        kit.same_bits(output, whole)
        assert kit.names(tmp_path) == ["v.h5", "whole.h5"]
    assert kept > 0


def test_failing_copies_and_memory_that_is_missed(run, scan, tmp_path, capfd, monkeypatch, launches, copies) -> None:
    """At a launch, or where an allocator refuses above a limit, as a device's does that somebody else uses too."""
    command = ["reconstruct", scan, "-o", tmp_path / "v.h5", "--method"]
    real, held = kit.cl.Buffer, []

    def missed(method: str, words: str = "") -> None:
        assert run(*command, method) == 6
        line = capfd.readouterr().err.splitlines()[-1]
        assert line.startswith("phyradgs: memory of ") and words in line and kit.names(tmp_path) == []

    def small(context: object, flags: object, size: int) -> object:
        if sum(held) + size > 3_000:
            raise kit.cl_error(-4)
        held.append(size)
        return real(context, flags, size)

    for method in ("fdk", "sirt"):
        copies.arm(2)
        assert run(*command, method) == 5 and "failed (injected" in capfd.readouterr().err.splitlines()[-1]
    copies.arm(None)
    for code in (-4, -5, -6):
        launches.arm(1, code)
        missed("sirt")
    launches.arm(None)
    monkeypatch.setattr(context.cl, "Buffer", small)
    for method in ("fdk", "sirt", "phyradgs"):
        held.clear()
        missed(method, "MEM_OBJECT_ALLOCATION_FAILURE")


def test_memory_that_is_missed_late_leaves_the_checkpoint(run, scan, tmp_path, capfd, copies) -> None:
    """The launch went well, and whatever waits for it next is told."""
    whole, output, options = tmp_path / "whole.h5", tmp_path / "v.h5", RUNS["phyradgs"]
    assert run(*command(scan, whole, options)) == 0
    copies.arm(int(0.95 * copies.calls), -5)
    capfd.readouterr()
    assert run(*command(scan, output, options)) == 6
    line = capfd.readouterr().err.splitlines()[-1]
    assert line.startswith("phyradgs: memory of ") and "--resume continues from iteration" in line
    assert checkpoint_path(output).exists() and not output.exists()
    copies.arm(None)
    assert run(*command(scan, output, options), "--resume") == 0
    kit.same_bits(output, whole)


@pytest.mark.parametrize("code", [-5, -36])
def test_a_driver_that_ended_a_kernel(run, scan, tmp_path, capfd, monkeypatch, caplog, launches, code) -> None:
    """Out of resources, says the launch, and the context is dead: smaller bricks would fail too."""

    def dead(*_: object, **__: object) -> object:
        raise kit.cl_error(code)

    for method in ("fdk", "sirt"):
        launches.arm(1, code)
        with monkeypatch.context() as patch:
            patch.setattr(kit.cl, "enqueue_fill_buffer", lambda *given: dead() if launches.calls else kit.fill(*given))
            assert run("reconstruct", scan, "-o", tmp_path / "v.h5", "--method", method) == 5
        line = capfd.readouterr().err.splitlines()[-1]
        assert all(words in line for words in ("phyradgs: device ", "ended a kernel", "devices --check"))
        assert launches.calls == 1 and "smaller bricks" not in caplog.text
    assert kit.names(tmp_path) == []


# In a process of its own that may map no more than so many MiB beyond what it has at the start.
LIMITED = """
import resource, sys
from pathlib import Path
from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.runtime import Runtime
cli = load_cli()
Runtime()
pages = int(Path("/proc/self/statm").read_text().split()[0])
limit = pages * resource.getpagesize() + (int(sys.argv[1]) << 20)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
sys.exit(cli.run(sys.argv[2:]))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="address space limits of POSIX")
def test_a_machine_without_memory_is_said(tmp_path) -> None:
    output = tmp_path / "v.h5"
    output.write_bytes(kit.OLD)
    words = ["simulate", "--phantom", "jaw", "--size", "512", "--detector", "16", "--views", "2"]
    command = [sys.executable, "-c", LIMITED, "256", *words, "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    lines = [line for line in done.stderr.splitlines() if line.startswith("phyradgs:")]
    assert (done.returncode, len(lines)) == (6, 1), done.stderr
    assert lines[0].startswith("phyradgs: memory of ") and "Traceback" not in done.stderr
    assert output.read_bytes() == kit.OLD and kit.names(tmp_path) == ["v.h5"]
