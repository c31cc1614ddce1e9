"""Benchmarks run, at their smallest; no figure of theirs is looked at but for being there."""

import json
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


def run(name: str, *words: str) -> str:
    env = {**os.environ, "PYTHONPATH": str(FOLDER.parent)}
    command = [sys.executable, str(FOLDER / name), *words]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def facts_of(tmp_path: Path, name: str, *words: str) -> dict:
    path = tmp_path / "facts.json"
    run(name, "--quick", "--json", str(path), *words)
    facts = json.loads(path.read_text())
    assert facts["device"] and facts["load_before"] >= 0
    return facts


def test_the_demo(tmp_path) -> None:
    """Its table has every run with its motion, and its processor seconds are counted in the sum."""
    lines = run("demo.py", str(tmp_path), "--quick").splitlines()
    start = next(n for n, line in enumerate(lines) if line.startswith("method "))
    *rows, total = (line.split() for line in lines[start + 1 : start + 6])
    assert [row[:2] for row in rows] == [["fdk", "ignored"], ["fista", "ignored"], ["fista", "known"], ["phyradgs", "known"]]
    used_s = [float(row[-1]) for row in rows]
    assert min(used_s) > 0 and sum(used_s) < float(total[-1])  # the simulation is in the sum
    assert float(rows[2][2]) > float(rows[1][2])  # PSNR, motion known and ignored
    assert (tmp_path / "demo.png").read_bytes().startswith(b"\x89PNG")


def test_volumes_before_and_after(tmp_path) -> None:
    """The same code has the same bits; a volume that was another before is named with its size."""
    kept = tmp_path / "before.npz"
    run("identity.py", str(kept), "fdk")
    assert "2 of 2 volumes have the same bits" in run("identity.py", str(kept), "fdk")
    before = dict(np.load(kept))
    np.savez(kept, **{**before, "fdk, static": before["fdk, static"] * 1.25})
    words = [sys.executable, str(FOLDER / "identity.py"), str(kept), "fdk"]
    done = subprocess.run(words, env={**os.environ, "PYTHONPATH": str(FOLDER.parent)}, capture_output=True, text=True)
    assert done.returncode == 1 and "fdk, static: 2.0e-01" in done.stdout


def test_densities_in_every_geometry(tmp_path) -> None:
    """Each geometry by one method, in turn: none is off by more than 2 % without a warning."""
    rows, table = tmp_path / "rows.jsonl", tmp_path / "table.md"
    run("geometries.py", "--quick", "--json", str(rows), "--table", str(table))
    found = [json.loads(line) for line in rows.read_text(encoding="utf-8").splitlines()]
    assert len(found) > 90 and {row["method"] for row in found} >= {"fista", "sirt", "fdk", "phyradgs"}
    assert "| cone: helices" in table.read_text(encoding="utf-8")


def test_what_a_gpu_would_say(tmp_path) -> None:
    facts = facts_of(tmp_path, "gpu.py", "--table", str(tmp_path / "table.md"))
    assert facts["trusted"] and facts["same_bits"] and "passed" in facts["tests"] and not facts["errors"]
    assert min(facts[name] for name in ("iteration_ms", "run_s", "fista_tv_s", "fdk_gups")) > 0
    assert facts["device"] in (tmp_path / "table.md").read_text(encoding="utf-8")


def test_benchmarks_that_append_lines_are_resumed(tmp_path) -> None:
    x = np.linspace(-1, 1, 32)
    with h5py.File(tmp_path / "ball_32.h5", "w") as file:
        file["volume"] = (x[:, None, None] ** 2 + x[:, None] ** 2 + x**2 < 0.5).astype(np.float32)
    for name, words, facts in (
        ("calibrate.py", "{tmp} {lines} --cases wobble --size 16 --views 8 --seeds 1", {"case": "wobble", "seed": 1}),
        ("bead_bias.py", "{lines} --size XS --trials stop-and-shoot", {"trial": "stop-and-shoot", "method": "fista-tv"}),
        ("fan_fly.py", "{lines} --side 28 --iterations 2 --trials 1", {"side": 28, "method": "fdk", "model": "ignored"}),
    ):
        lines = tmp_path / f"{name}.jsonl"
        asked = [word.format(tmp=tmp_path, lines=lines) for word in words.split()]
        first = run(name, *asked)
        assert lines.read_text() == first and facts.items() <= json.loads(first).items()
        assert run(name, *asked) == "" and lines.read_text() == first
