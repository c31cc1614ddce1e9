"""--memory: the same results within a limit, and one line where it does not suffice."""

import re
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.io import read_volume
from phyradgs_cl.reconstructors import run as room
from phyradgs_cl.runtime import MEMORY_VARIABLE, context
from phyradgs_cl.workflow import load_scan

pytestmark = pytest.mark.slow
VOLUME = ["--phantom", "jaw", "--size", "24", "--detector", "20", "--views", "4", "--time-samples", "2"]


@pytest.fixture(scope="module")
def scan(simulated) -> Path:
    return simulated(*VOLUME)


@pytest.mark.parametrize("method", ["sirt --iterations 2", "fdk"])
def test_reconstruction_in_bricks(cli, scan, tmp_path, method, monkeypatch) -> None:
    """24³ voxels are 26·26·48 padded floats, 127 KiB, or 108 KiB for FDK."""
    ledgers, made, volumes = [], context.MemoryLedger, []
    monkeypatch.setattr(context, "MemoryLedger", lambda *given: ledgers.append(made(*given)) or ledgers[-1])
    for more in ([], ["--memory", "100KiB"]):
        output = tmp_path / f"{len(more)}.h5"
        assert cli.run(["reconstruct", str(scan), "-o", str(output), "--method", *method.split(), *more]) == 0
        volumes.append(read_volume(output).values)
    assert ledgers[0].peak_bytes > ledgers[1].limit_bytes >= ledgers[1].peak_bytes
    np.testing.assert_allclose(volumes[1], volumes[0], rtol=0, atol=1e-5 * volumes[0].max())
    assert cli.run(["estimate", str(scan), "--method", *method.split(), "--memory", "100KiB"]) == 0


@pytest.mark.parametrize("method", ["fista --iterations 1 --memory 3MiB", "fdk"])
def test_a_size_that_does_not_fit_is_refused_with_one_that_does(cli, refused, scan, tmp_path, monkeypatch, method) -> None:
    """On the device, and in a machine with 8 MiB: before the run, not after it, when the volume is made."""
    for name in ("host_bytes", "free_bytes") if method == "fdk" else ():
        monkeypatch.setattr(room, name, lambda: 8 * 2.0**20)
    run = ["reconstruct", scan, "-o", tmp_path / "v.h5", "--method", *method.split(), "--size"]
    words = ("200×200×200 voxels", "in one volume") if method == "fdk" else ("fits",)
    size = int(re.search(r"--size (\d+) fits", refused([*run, "200"], *words, status=6))[1])
    assert (48 <= size <= 80 if method == "fdk" else 12 <= size < 200)
    assert cli.run([str(word) for word in [*run, size]]) == 0


def test_too_little_and_a_wrong_size_are_named_where_they_stand(refused, scan, tmp_path, monkeypatch) -> None:
    output, config = tmp_path / "v.h5", tmp_path / "run.toml"
    config.write_text('memory = "much"\n')
    run = ["reconstruct", scan, "-o", output, "--iterations", "2"]
    refused([*run, "--memory", "20KiB"], "--memory", status=6)
    refused([*run, "--memory", "much"], "--memory: found 'much'")
    refused([*run, "--config", config], f"config {config}: memory: found 'much'")
    monkeypatch.setenv(MEMORY_VARIABLE, "much")
    refused(run, f"{MEMORY_VARIABLE}: found 'much'")
    assert not output.exists()


def test_simulation_in_bricks(cli, scan, tmp_path) -> None:
    """The phantom has twice as many voxels per side: 50·50·64 padded floats, 625 KiB."""
    found = tmp_path / "bricks.h5"
    assert cli.run(["simulate", *VOLUME, "--memory", "350KiB", "-o", str(found)]) == 0
    expected = load_scan(scan).projections
    np.testing.assert_allclose(load_scan(found).projections, expected, rtol=0, atol=3e-6 * expected.max())
