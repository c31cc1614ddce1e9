"""A sweep's file: its runs, and the errors that are raised before any run."""

import os
import shutil
from pathlib import Path

import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.settings import read_config
from phyradgs_cl.workflow.sweep import SweepGrid, plan_sweep, read_grid

GRID = 'scans = ["*.h5"]\n'
MANY = list(range(1, 400))


@pytest.fixture
def read(tmp_path: Path, tiny_scan: Path):
    """A function that writes GRID.toml next to two scans and reads it."""
    for name in ("a.h5", "b.h5"):
        shutil.copy(tiny_scan, tmp_path / name)

    def reading(text: str) -> SweepGrid:
        path = tmp_path / "grid.toml"
        path.write_text(text)
        return read_grid(read_config(path, "GRID"), path)

    return reading


def test_grids_are_tried_like_other_options_and_methods_in_any_case(read) -> None:
    grid = read(GRID + '[[grid]]\nmethod = ["FDK", "fdk"]\nsize = [8, [4, 5, 6]]\n')
    assert [setting.label for setting in grid.settings] == ["fdk size=8", "fdk size=4,5,6"]
    run = plan_sweep(grid, Path("results"))[-1]
    assert run.setting.plan().preprocessing.size == (4, 5, 6) and run.facts["input"] == {"size": [4, 5, 6]}


def test_lists_are_multiplied_and_runs_taken_as_they_are(read) -> None:
    grid = read(
        GRID
        + """
        seeds = [0, 3, 0]
        [options]
        holdout = 3
        [[grid]]
        method = ["sirt", "cgls"]
        motion = ["static", "per-row"]
        iterations = [5, 20]
        [[grid]]
        method = "phyradgs"
        control.every = [50, 100]
        rates.position = [[2e-4, 2e-5]]
        [[runs]]
        method = "fdk"
        preset = "hann"
        """
    )
    assert [scan.name for scan in grid.scans] == ["a.h5", "b.h5"] and grid.seeds == (0, 3)
    assert len(grid.settings) == 8 + 2 + 1
    first, splats, fdk = grid.settings[0], grid.settings[8], grid.settings[10]
    assert first.label == "sirt holdout=3 motion=static iterations=5"
    assert (first.plan().options.iterations, first.plan().options.motion.name) == (5, "static")
    assert first.before == {"holdout": 3}
    assert splats.plan().options.control.every == 50 and splats.plan().options.rates.position == (2e-4, 2e-5)
    assert (fdk.method, fdk.preset) == ("fdk", "hann")


def test_what_is_asked_for_twice_is_run_once_and_names_differ(read, tmp_path) -> None:
    sirt = 'method = "sirt"\niterations ='
    grid = read(GRID + f"[[grid]]\n{sirt} [5, 6, 5]\n[[runs]]\n{sirt} 6\n")
    plan = plan_sweep(grid, tmp_path / "out")
    assert len(grid.settings) == 2 and len(plan) == 4 == len({run.name for run in plan})
    assert len({run.output for run in plan}) == 4
    again = plan_sweep(grid, tmp_path / "elsewhere")
    assert [run.name for run in again] == [run.name for run in plan]


def test_what_is_wrong_is_named_at_once(read) -> None:
    for text, message in (
        ('scnas = ["*.h5"]\n', "scnas: found a key that is not known.*did you mean 'scans'"),
        ("[[runs]]\n", "scans: found None; expected a list"),
        ('scans = "a.h5"\n[[runs]]\n', "scans: found 'a.h5'"),
        (GRID, r"neither \[\[grid\]\] nor \[\[runs\]\]"),
        (GRID + "grid = 3\n", "grid: found 3"),
        (GRID + "seeds = [-1]\n[[runs]]\n", r"seeds: found \[-1\]"),
        (GRID + "seeds = [true]\n[[runs]]\n", "seeds: found"),
        ('scans = ["none/*.h5"]\n[[runs]]\n', "no file for 'none/"),
        ('scans = ["grid.toml"]\n[[runs]]\n', "grid.toml: found a file that is not HDF5"),
        (GRID + '[[grid]]\nmethod = ["sirt", "sitr"]\n', r"\[\[grid\]\] 1 \(method='sitr'\): --method"),
        (GRID + "[[runs]]\nmethod = 'phyradgs'\ntv_wieght = 0.1\n", r"\[\[runs\]\] 1 .*tv_wieght.*did you mean 'tv_weight'"),
        (GRID + "[[grid]]\nmethod = ['phyradgs']\ncontrol.evrey = [1]\n", "evrey.*did you mean 'every'"),
        (GRID + '[[grid]]\nmethod = "fdk"\npreset = ["hann", "ham"]\n', "preset='ham'.*found 'ham'"),
        (GRID + "[[grid]]\niterations = [10, -1]\n", "iterations=-1"),
        (GRID + "[[grid]]\niterations = []\n", "iterations: found an empty list"),
        (GRID + "[[grid]]\nholdout = [0, 60]\n", "holdout=60"),
        (GRID + "[[runs]]\nseed = 1\n", "seed: found 1; expected no option of a run; write seeds"),
        (GRID + '[[runs]]\ndevice = "gpu"\n', "device.*say it as --device"),
        (GRID + "[[runs]]\n[options]\niteratoins = 5\n", "iteratoins.*did you mean 'iterations'"),
        (GRID + "[options]\nrates = 1\n[[runs]]\nrates.position = [2e-4, 2e-5]\n", "found rates=1 too"),
        (GRID + f"[[grid]]\niterations = {MANY}\ngaussians = {MANY}\n", "runs; expected at most"),
    ):
        with pytest.raises(InputError, match=message):
            read(text)


def test_patterns_meet_regular_files_only(read, tmp_path) -> None:
    """A pipe is waited for; links to folders may go round in a circle."""
    (tmp_path / "below/deep").mkdir(parents=True)
    (tmp_path / "below/loop").symlink_to(tmp_path)
    shutil.copy(tmp_path / "a.h5", tmp_path / "below/deep/c.h5")
    os.mkfifo(tmp_path / "below/pipe.h5")
    grid = read('scans = ["**/*.h5", "./b*/d?ep/[c].h5", "a.h5"]\n[[runs]]\n')
    assert [path.name for path in grid.scans] == ["a.h5", "b.h5", "c.h5"]
    assert read(f'scans = ["{tmp_path}/*/*/c.h5"]\n[[runs]]\n').scans == grid.scans[2:]
    with pytest.raises(InputError, match="not a regular file"):
        read('scans = ["below/pipe.h5"]\n[[runs]]\n')
    with pytest.raises(InputError, match="no file for"):
        read('scans = ["below/*.h5"]\n[[runs]]\n')
