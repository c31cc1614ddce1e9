"""Sweeps in one process: a sweep's file and its errors, runs that go on, failures tried again, and the table."""

import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from phyradgs_cl.errors import DeviceError, InputError, OutputError
from phyradgs_cl.io import checkpoint_path, only_run, read_volume
from phyradgs_cl.io.output import BusyError
from phyradgs_cl.reconstructors import Progress, plan_run
from phyradgs_cl.workflow import sweep as sweep_run
from phyradgs_cl.workflow.reconstruct import resume_or_restart
from phyradgs_cl.workflow.sweep import RESULTS, markdown, plan_sweep, read_lines, run_sweep

pytestmark = pytest.mark.slow
TEXT = """
scans = ["*.h5"]
seeds = [0, 1]
[[grid]]
method = "sirt"
iterations = [2, 4]
[[runs]]
method = "fdk"
"""
RUNS = 2 * 3 * 2


class Sweep:
    """A grid of two scans and its folder of results."""

    def __init__(self, folder: Path) -> None:
        self.grid, self.folder = folder / "grid.toml", folder / "out"
        self.grid.write_text(TEXT)

    def run(self, **more: object) -> int:
        return run_sweep(plan_sweep(self.grid, self.folder), self.folder, **more)  # type: ignore[arg-type]

    def lines(self) -> list[dict]:
        return read_lines(self.folder / RESULTS)


@pytest.fixture
def sweep(tmp_path: Path, tiny_scan: Path) -> Sweep:
    for name in ("a.h5", "b.h5"):
        shutil.copy(tiny_scan, tmp_path / name)
    return Sweep(tmp_path)


def test_every_run_is_in_the_file_once_with_what_it_depends_on(sweep) -> None:
    """In the table too; a scan that was replaced is run again."""
    told, reports = [], []
    assert sweep.run(tell=lambda done, line: told.append(done), report=reports.append) == 0
    lines = sweep.lines()
    assert len(lines) == RUNS == len({line["run"] for line in lines}) and told == list(range(1, RUNS + 1)) and reports
    needed = {"version", "device", "seed", "options", "seconds", "metrics", "numpy", "python", "scan", "host"}
    assert all(needed <= line.keys() and {"psnr_db", "ssim"} <= line["metrics"].keys() for line in lines)
    stored = read_volume(sweep.folder / lines[0]["volume"])
    assert stored.metrics["psnr_db"] == pytest.approx(lines[0]["metrics"]["psnr_db"])
    text = (sweep.folder / "results.md").read_text()
    (row,) = [line for line in text.splitlines() if line.startswith("| sirt iterations=4 |")]
    scores = [line["metrics"]["psnr_db"] for line in lines if line["label"] == "sirt iterations=4"]
    assert row.split("|")[2].strip() == "4" and f"{sum(scores) / 4:.2f} ±" in row and "held-out" not in text
    held_out = {"label": "one", "seconds": 1.0, "metrics": {"holdout_rms": 0.01234, "holdout_noise_rms": 0.0111}}
    title, _, row = markdown([held_out], 1).splitlines()[2:]
    assert "| held-out RMS | noise RMS |" in title and "| 0.01234 | 0.0111 |" in row
    os.utime(lines[0]["scan"], ns=(1, 1))
    sweep.run()
    again = sweep.lines()[RUNS:]
    assert len(again) == RUNS // 2 and {line["scan"] for line in again} == {lines[0]["scan"]}


def test_a_sweep_goes_on_where_it_was_stopped(sweep) -> None:
    def stop_after_five(done: int, line: dict) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep.run(tell=stop_after_five)
    whole = (sweep.folder / RESULTS).read_bytes()
    assert whole.count(b"\n") == 5
    (sweep.folder / RESULTS).write_bytes(whole[:-30])  # killed while the last line was written
    told = []
    sweep.run(tell=lambda done, line: told.append(done))
    assert told == list(range(5, RUNS + 1)) and len(sweep.lines()) == RUNS == len({line["run"] for line in sweep.lines()})
    sweep.run()
    assert len(sweep.lines()) == RUNS


def test_failures_are_noted_and_tried_again(cli, sweep, monkeypatch, capsys) -> None:
    original = sweep_run.resume_or_restart
    errors = (InputError("scan", "no good | at all"), ZeroDivisionError("a defect"))
    errors += DeviceError("device", "lost"), BusyError("volume", "busy")

    def failing(plan, scan, *rest):
        if plan.method == "fdk":
            raise errors[2 * (scan.name == "a.h5") + plan.seed]
        return original(plan, scan, *rest)

    monkeypatch.setattr(sweep_run, "resume_or_restart", failing)
    monkeypatch.setattr(sweep_run, "_BUSY_S", 0.0)
    assert cli.run(["sweep", str(sweep.grid), "-o", str(sweep.folder)]) == 2 and "4 runs failed" in capsys.readouterr().err
    noted = sorted(line["error"] for line in sweep.lines() if "error" in line)
    assert noted[:2] == ["ZeroDivisionError: a defect", "device: found lost"]
    assert noted[2:] == ["scan: found no good | at all", "volume: found busy"]
    text = (sweep.folder / "results.md").read_text()
    assert f"{RUNS - 4} of {RUNS} runs, 4 failed" in text and "no good \\| at all" in text
    monkeypatch.undo()
    assert sweep.run() == 0 and len([line for line in sweep.lines() if "error" not in line]) == RUNS
    assert "failed run" not in (sweep.folder / "results.md").read_text()


def test_a_full_disk_ends_the_sweep_and_lines_are_json_without_nan(sweep, monkeypatch) -> None:
    original = sweep_run.resume_or_restart
    monkeypatch.setattr(sweep_run, "resume_or_restart", Mock(side_effect=OutputError("volume", "no room")))
    with pytest.raises(OutputError, match="no room"):
        sweep.run()
    assert sweep.lines() == []
    monkeypatch.setattr(sweep_run, "resume_or_restart", lambda *given: (original(*given)[0], {"psnr_db": float("inf")}))
    sweep.run()
    rows = (sweep.folder / RESULTS).read_text().splitlines()
    assert [json.loads(row, parse_constant=pytest.fail)["metrics"]["psnr_db"] for row in rows] == RUNS * [None]


def test_the_command_needs_no_dask_for_one_run_after_the_other(cli, sweep, monkeypatch, refused, capfd) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    command = ["sweep", str(sweep.grid), "-o", str(sweep.folder)]
    assert cli.run(command) == 0 and f"{RUNS}/{RUNS} " in capfd.readouterr().out
    with only_run(sweep.folder / RESULTS), pytest.raises(BusyError, match="another run"):
        sweep.run()
    (sweep.folder / RESULTS).unlink()
    refused([*command, "--workers", "2"], "pip install 'phyradgs-cl[cluster]'")
    refused([*command, "--device", " "], "--device")
    refused(["sweep", sweep.grid.with_name("none.toml"), "-o", sweep.folder])
    sweep.grid.write_text(TEXT.replace("iterations", "iteration"))
    refused(command)


PLAN = plan_run("sirt", {"iterations": 6})


@pytest.fixture
def again(rt, tiny_scan, tmp_path):
    """A run that may be stopped at an iteration → its result, and the iterations that it reported."""

    def go(stop_at=None, plan=PLAN, scan=tiny_scan, name="volume.h5"):
        seen = []

        def report(progress: Progress) -> None:
            seen.append(progress.iteration)
            if progress.iteration == stop_at:
                raise KeyboardInterrupt

        return resume_or_restart(plan, scan, tmp_path / name, lambda: rt, report)[0], seen

    return go


def test_a_stopped_run_goes_on_to_the_same_bits_and_no_other_method_takes_its_checkpoint(again, tmp_path) -> None:
    checkpoint = checkpoint_path(tmp_path / "volume.h5")
    assert again(stop_at=3)[0].interrupted_at
    with pytest.raises(InputError, match="none.h5"):
        again(scan=tmp_path / "none.h5")
    assert checkpoint.exists()
    result, seen = again()
    assert not result.interrupted_at and min(seen) > 3 and not checkpoint.exists()
    np.testing.assert_array_equal(result.volume, again(name="alone.h5")[0].volume)
    again(stop_at=3)
    assert checkpoint.exists() and not again(plan=plan_run("fdk"))[0].interrupted_at


@pytest.mark.parametrize("what", ["damaged", "of another seed"])
def test_a_checkpoint_that_does_not_fit_is_set_aside(again, tmp_path, what) -> None:
    checkpoint = checkpoint_path(tmp_path / "volume.h5")
    again(stop_at=3)
    content = checkpoint.read_bytes()
    if what == "damaged":
        checkpoint.write_bytes(content := content[: len(content) // 2])
    result, seen = again(plan=PLAN if what == "damaged" else replace(PLAN, seed=1))
    assert not result.interrupted_at and min(seen) <= 3 and Path(f"{checkpoint}.bak").read_bytes() == content


SCANS = 'scans = ["*.h5"]\n'


@pytest.fixture
def plan(sweep):
    """A function that writes grid.toml next to two scans and plans its runs."""
    return lambda text: (sweep.grid.write_text(text), plan_sweep(sweep.grid, sweep.folder))[1]


def test_lists_are_multiplied_and_runs_taken_as_they_are(plan) -> None:
    runs = plan(SCANS + """
        seeds = [0, 3, 0]
        options.holdout = 3
        [[grid]]
        method = ["sirt", "cgls"]
        motion = ["static", "per-row"]
        iterations = [5, 20]
        [[grid]]
        method = "phyradgs"
        control.every = [50, 100]
        rates.position = [[2e-4, 2e-5]]
        [[runs]]
        method = "FDK"
        size = [4, 5, 6]
    """)  # fmt: skip
    assert len(runs) == 2 * (8 + 2 + 1) * 2 and [run.scan.name for run in runs[:: len(runs) // 2]] == ["a.h5", "b.h5"]
    assert [run.plan.seed for run in runs[:4]] == [0, 3, 0, 3]
    first, splats, fdk = runs[0], runs[16], runs[20]
    assert first.facts["label"] == "sirt holdout=3 motion=static iterations=5"
    assert (first.plan.options.iterations, first.plan.options.motion.name) == (5, "static")
    assert first.plan.preprocessing.holdout == 3
    assert splats.plan.options.control.every == 50 and splats.plan.options.rates.position == (2e-4, 2e-5)
    assert (fdk.facts["method"], fdk.plan.preprocessing.size) == ("fdk", (4, 5, 6))


def test_what_is_asked_for_twice_is_run_once_and_names_differ(plan, tmp_path) -> None:
    sirt = 'method = "sirt"\niterations ='
    text = SCANS + f"[[grid]]\n{sirt} [5, 6, 5]\n[[runs]]\n{sirt} 6\n"
    names = [run.facts["run"] for run in plan(text)]
    assert len(names) == 4 == len(set(names)) and names == [run.facts["run"] for run in plan(text)]
    shutil.copy(tmp_path / "b.h5", tmp_path / "a.h5")  # another time: another scan
    assert len({*names, *(run.facts["run"] for run in plan(text))}) == 6


def test_what_is_wrong_is_named_at_once(plan) -> None:
    for text, message in (
        ('scnas = ["*.h5"]\n', "scnas: found a key that is not known.*did you mean 'scans'"),
        ("[[runs]]\n", "scans: found None; expected a list"), (SCANS + "grid = 3\n", "grid: found 3"),
        (SCANS, r"neither \[\[grid\]\] nor \[\[runs\]\]"), (SCANS + "seeds = [true]\n[[runs]]\n", "seeds: "),
        (SCANS + "options = 3\n[[runs]]\n", r"options: found \[3\]"), (SCANS + "seeds = [-1]\n[[runs]]\n", "--seed: "),
        ('scans = ["grid.toml"]\n[[runs]]\n', "grid.toml: found a file that is not HDF5"),
        (SCANS + '[[grid]]\nmethod = ["sirt", "sitr"]\n', r"grid.toml \(method='sitr'\): --method"),
        (SCANS + "[[grid]]\niterations = []\n", "found an empty list"),
        (SCANS + "[[runs]]\n[options]\niteratoins = 5\n", "iteratoins.*did you mean 'iterations'"),
    ):
        with pytest.raises(InputError, match=message):
            plan(text)


def test_patterns_meet_regular_files_at_any_depth(plan, tmp_path) -> None:
    (tmp_path / "below/deep").mkdir(parents=True)
    shutil.copy(tmp_path / "a.h5", tmp_path / "below/deep/c.h5")
    (tmp_path / "below/folder.h5").mkdir()
    runs = plan('scans = ["**/*.h5", "./b*/d?ep/[c].h5", "a.h5"]\n[[runs]]\n')
    assert [run.scan.name for run in runs] == ["a.h5", "b.h5", "c.h5"]
    assert [run.scan for run in plan(f'scans = ["{tmp_path}/*/*/c.h5"]\n[[runs]]\n')] == [runs[2].scan]
    with pytest.raises(InputError, match="no file for"):
        plan('scans = ["below/*.h5"]\n[[runs]]\n')
