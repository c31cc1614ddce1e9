"""Benchmarks run, at their smallest; no figure of theirs is looked at but for being there."""

import json
import runpy
import sys
from pathlib import Path

import pytest

from phyradgs_cl import device_check

pytestmark = pytest.mark.slow

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def run(monkeypatch, capsys):
    """(name, words...) → what a benchmark prints, run in this process."""

    def run(name: str, *words: str) -> str:
        monkeypatch.setattr(sys, "argv", [str(FOLDER / name), *words])
        capsys.readouterr()
        try:
            runpy.run_path(sys.argv[0], run_name="__main__")
        except SystemExit as ended:
            assert not ended.code, name
        return capsys.readouterr().out

    return run


def test_the_demo(tmp_path, run, monkeypatch) -> None:
    """Its table has every run with its motion, and its processor seconds are counted in the sum."""
    monkeypatch.setenv("PYTHONPATH", str(FOLDER.parent))
    lines = run("demo.py", str(tmp_path), "--quick").splitlines()
    start = next(n for n, line in enumerate(lines) if line.startswith("method "))
    *rows, total = (line.split() for line in lines[start + 1 : start + 6])
    assert [row[:2] for row in rows] == [["fdk", "ignored"], ["fista", "ignored"], ["fista", "known"], ["phyradgs", "known"]]
    used_s = [float(row[-1]) for row in rows]
    assert min(used_s) > 0 and sum(used_s) < float(total[-1])  # the simulation is in the sum
    assert float(rows[2][2]) > float(rows[1][2])  # PSNR, motion known and ignored
    assert (tmp_path / "demo.png").read_bytes().startswith(b"\x89PNG")


def test_densities_in_every_geometry(tmp_path, run) -> None:
    """One method each, in turn: none is off by more than 2 % without a warning. Six cells take longer than the others:
    their lines are there, and are not run again."""
    rows, table = tmp_path / "rows.jsonl", tmp_path / "table.md"
    tilted = "fly-scan, tilted by 3°, rolled by 2°"
    costly = [
        *(("fista", f"{beam}, {tilted}") for beam in ("cone", "parallel")), ("fista", "cone, pixel 3 voxels"),
        ("fista", "parallel, pixel 4 voxels"), ("fista-tv", "cone, pixel 4 voxels"), ("phyradgs", "cone, pixel 1.5 voxels"),
    ]  # fmt: skip
    lines = [json.dumps({"case": case, "method": method, "warnings": []}) for method, case in costly]
    rows.write_text("".join(line + "\n" for line in lines))
    run("geometries.py", "--quick", "--json", str(rows), "--table", str(table))
    found = [json.loads(line) for line in rows.read_text(encoding="utf-8").splitlines()]
    assert len(found) > 60 and {row["method"] for row in found} >= {"fista", "sirt", "fdk", "phyradgs"}
    assert "| cone: helices" in table.read_text(encoding="utf-8")


def test_what_a_gpu_would_say(tmp_path, run, monkeypatch) -> None:
    """One of the checks of a device stands for all."""
    monkeypatch.setattr(device_check, "CHECKS", (device_check._optimiser,))
    words = ["--quick", "--json", str(tmp_path / "facts.json"), "--table", str(tmp_path / "table.md")]
    run("gpu.py", *words)
    facts = json.loads((tmp_path / "facts.json").read_text())
    assert facts["device"] and facts["load_before"] >= 0
    assert facts["trusted"] and facts["same_bits"] and "passed" in facts["tests"] and not facts["errors"]
    assert min(facts[name] for name in ("iteration_ms", "run_s", "fista_tv_s", "fdk_gups")) > 0
    assert facts["device"] in (tmp_path / "table.md").read_text(encoding="utf-8")
