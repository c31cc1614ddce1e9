"""Runs that are killed leave their last checkpoint, and go on from it to the bits of a run that was not."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from stress import TIMES

from phyradgs_cl.io import checkpoint_path, read_volume
from phyradgs_cl.io.output import lock_path

pytestmark = pytest.mark.slow
TINY = ["--phantom", "jaw", "--size", "12", "--detector", "16", "--views", "4", "--time-samples", "2"]
# every other method goes on from its state in tests/reconstructors (test_iterative, test_changing, test_object_motion)
SPLATS = ["--method", "phyradgs", "--iterations", "60", "--gaussians", "60"]
SPLATS += ["--set", "control.start_iteration=20", "--set", "control.every=30"]


@pytest.fixture(scope="module")
def scan(simulated) -> Path:
    return simulated(*TINY, "--noise", "tigre")


def words_of(scan: Path, output: Path, options: list[str]) -> list[str]:
    """A run that keeps a checkpoint at every report."""
    return ["reconstruct", str(scan), "-o", str(output), *options, "--checkpoint-every", "1e-6"]


def kill_in_the_middle(words: list[str], output: Path, after_s: float) -> None:
    """SIGKILL ``after_s`` seconds after the first new checkpoint, or as the run has ended by itself."""
    path, command = checkpoint_path(output), [sys.executable, "-m", "phyradgs_cl", *words]
    before = path.stat().st_mtime_ns if path.exists() else None
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while process.poll() is None and time.monotonic() < deadline:
        if path.exists() and path.stat().st_mtime_ns != before:
            break
        time.sleep(0.002)
    time.sleep(after_s)
    process.send_signal(signal.SIGKILL)
    process.wait()


def test_killed_runs_end_with_the_bits_of_one_that_was_not(cli, scan, tmp_path) -> None:
    whole, killed, options = tmp_path / "whole.h5", tmp_path / "killed.h5", SPLATS
    assert cli.run(words_of(scan, whole, options)) == 0 and list(tmp_path.iterdir()) == [whole]
    rng, run = np.random.default_rng(8), words_of(scan, killed, options)
    for kill in range(TIMES):  # STRESS=50 is what `make stress` sets
        kill_in_the_middle(run if kill == 0 else [*run, "--resume"], killed, float(rng.uniform(0, 0.05)))
        if killed.exists():  # it was too fast: from the start again
            killed.unlink()
            checkpoint_path(killed).unlink(missing_ok=True)
            kill_in_the_middle(run, killed, 0.0)
    resume = ["--resume"] if checkpoint_path(killed).exists() else []
    assert cli.run(words_of(scan, killed, [*options, *resume])) == 0
    np.testing.assert_array_equal(read_volume(killed).values, read_volume(whole).values)
    told = [[line["iteration"] for line in read_volume(path).provenance["record"]] for path in (killed, whole)]
    assert told[0] == told[1] and not checkpoint_path(killed).exists() and not lock_path(killed).exists()


def test_a_checkpoint_is_neither_needed_nor_lost(cli, scan, tmp_path, caplog) -> None:
    """It is a warning that none can be written, and a run that forgets one sets it aside."""
    output, short = tmp_path / "volume.h5", ["--method", "sirt", "--iterations", "3"]
    checkpoint_path(output).mkdir()
    assert cli.run(words_of(scan, output, short)) == 0 and output.exists() and caplog.text.count("no checkpoint") == 1
    checkpoint_path(output).rmdir()
    kill_in_the_middle(words_of(scan, output, [*short, "--iterations", "100000"]), output, 0.01)
    kept = checkpoint_path(output).read_bytes()
    assert cli.run(words_of(scan, output, short)) == 0 and "kept as volume.h5.checkpoint.npz.bak" in caplog.text
    assert checkpoint_path(output).with_name("volume.h5.checkpoint.npz.bak").read_bytes() == kept
