"""--memory: the same results within a limit, and one line where it does not suffice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.io import read_volume
from phyradgs_cl.runtime import MEMORY_VARIABLE, context
from phyradgs_cl.workflow import load_scan

VOLUME = ["--phantom", "jaw", "--size", "24", "--detector", "20", "--views", "4", "--time-samples", "2"]


@pytest.fixture(scope="module")
def scan(simulated) -> Path:
    return simulated(*VOLUME)


def test_simulation_in_bricks(cli, scan, tmp_path) -> None:
    """The phantom has twice as many voxels per side: 50·50·64 padded floats, 625 KiB."""
    found = tmp_path / "bricks.h5"
    assert cli.run(["simulate", *VOLUME, "--memory", "350KiB", "-o", str(found)]) == 0
    expected = load_scan(scan).projections
    np.testing.assert_allclose(load_scan(found).projections, expected, rtol=0, atol=3e-6 * expected.max())


@pytest.mark.parametrize("method", ["sirt", "fdk"])
def test_reconstruction_in_bricks(cli, scan, tmp_path, method, monkeypatch) -> None:
    """24³ voxels are 26·26·48 padded floats, 127 KiB, or 108 KiB for FDK."""
    run = ["reconstruct", str(scan), "--method", method, *(["--iterations", "2"] if method == "sirt" else [])]
    ledgers = []
    made = context.MemoryLedger

    def ledger(*arguments):
        ledgers.append(made(*arguments))
        return ledgers[-1]

    monkeypatch.setattr(context, "MemoryLedger", ledger)
    assert cli.run([*run, "-o", str(tmp_path / "whole.h5")]) == 0
    assert cli.run([*run, "-o", str(tmp_path / "bricks.h5"), "--memory", "100KiB"]) == 0
    assert ledgers[0].peak_bytes > ledgers[1].limit_bytes >= ledgers[1].peak_bytes
    whole, bricks = (read_volume(tmp_path / f"{name}.h5").volume for name in ("whole", "bricks"))
    np.testing.assert_allclose(bricks, whole, rtol=0, atol=1e-5 * whole.max())


def test_too_little_is_one_line(cli, scan, tmp_path, capsys) -> None:
    run = ["reconstruct", str(scan), "-o", str(tmp_path / "v.h5"), "--iterations", "2"]
    assert cli.run([*run, "--memory", "20KiB"]) == 6
    said = capsys.readouterr().err
    assert "--memory" in said and said.count("\n") <= 2 and "Traceback" not in said
    assert not (tmp_path / "v.h5").exists()


@pytest.mark.parametrize("where", ["option", "file", "environment"])
def test_a_wrong_size_is_named_where_it_stands(cli, scan, tmp_path, capsys, monkeypatch, where) -> None:
    config = tmp_path / "run.toml"
    config.write_text('memory = "much"\n')
    words = {"option": ["--memory", "much"], "file": ["--config", str(config)], "environment": []}[where]
    if where == "environment":
        monkeypatch.setenv(MEMORY_VARIABLE, "much")
    assert cli.run(["reconstruct", str(scan), "-o", str(tmp_path / "v.h5"), *words]) == 2
    named = {"option": "--memory", "file": f"config {config}: memory", "environment": MEMORY_VARIABLE}[where]
    assert f"{named}: found 'much'" in capsys.readouterr().err


def test_estimates_keep_to_it(cli, scan, capsys) -> None:
    assert (
        cli.run(["estimate", str(scan), "--method", "sirt", "--iterations", "2", "--memory", "100KiB"]) == 0
    )
    assert "memory" in capsys.readouterr().out
