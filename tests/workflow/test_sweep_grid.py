"""A sweep's file: its runs, and the errors that are raised before any run."""

import shutil
from pathlib import Path

import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.workflow.sweep import SweepRun, plan_sweep

pytestmark = pytest.mark.slow
GRID = 'scans = ["*.h5"]\n'


@pytest.fixture
def plan(tmp_path: Path, tiny_scan: Path):
    """A function that writes GRID.toml next to two scans and plans its runs."""
    for name in ("a.h5", "b.h5"):
        shutil.copy(tiny_scan, tmp_path / name)

    def planned(text: str) -> list[SweepRun]:
        (tmp_path / "grid.toml").write_text(text)
        return plan_sweep(tmp_path / "grid.toml", tmp_path / "out")

    return planned


def test_lists_are_multiplied_and_runs_taken_as_they_are(plan) -> None:
    runs = plan(GRID + """
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
    settings = 8 + 2 + 1
    assert len(runs) == 2 * settings * 2 and [run.scan.name for run in runs[:: len(runs) // 2]] == ["a.h5", "b.h5"]
    assert [run.plan.seed for run in runs[:4]] == [0, 3, 0, 3]
    first, splats, fdk = runs[0], runs[16], runs[20]
    assert first.facts["label"] == "sirt holdout=3 motion=static iterations=5"
    assert (first.plan.options.iterations, first.plan.options.motion.name) == (5, "static")
    assert first.plan.preprocessing.holdout == 3
    assert splats.plan.options.control.every == 50 and splats.plan.options.rates.position == (2e-4, 2e-5)
    assert (fdk.facts["method"], fdk.plan.preprocessing.size) == ("fdk", (4, 5, 6))


def test_what_is_asked_for_twice_is_run_once_and_names_differ(plan, tmp_path) -> None:
    sirt = 'method = "sirt"\niterations ='
    text = GRID + f"[[grid]]\n{sirt} [5, 6, 5]\n[[runs]]\n{sirt} 6\n"
    names = [run.facts["run"] for run in plan(text)]
    assert len(names) == 4 == len(set(names)) and names == [run.facts["run"] for run in plan(text)]
    shutil.copy(tmp_path / "b.h5", tmp_path / "a.h5")  # another time: another scan
    assert len({*names, *(run.facts["run"] for run in plan(text))}) == 6


def test_what_is_wrong_is_named_at_once(plan) -> None:
    for text, message in (
        ('scnas = ["*.h5"]\n', "scnas: found a key that is not known.*did you mean 'scans'"),
        ("[[runs]]\n", "scans: found None; expected a list"),
        (GRID, r"neither \[\[grid\]\] nor \[\[runs\]\]"), (GRID + "grid = 3\n", "grid: found 3"),
        (GRID + "options = 3\n[[runs]]\n", r"options: found \[3\]"), (GRID + "seeds = [-1]\n[[runs]]\n", "--seed: found -1"),
        (GRID + "seeds = [true]\n[[runs]]\n", "seeds: found"), ('scans = ["none/*.h5"]\n[[runs]]\n', "no file for 'none/"),
        ('scans = ["grid.toml"]\n[[runs]]\n', "grid.toml: found a file that is not HDF5"),
        (GRID + '[[grid]]\nmethod = ["sirt", "sitr"]\n', r"grid.toml \(method='sitr'\): --method"),
        (GRID + "[[grid]]\niterations = []\n", "found an empty list"),
        (GRID + "[[runs]]\n[options]\niteratoins = 5\n", "iteratoins.*did you mean 'iterations'"),
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
