"""What wins over what, and how a wrong value is named by the place where it stands."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors import RunPlan
from phyradgs_cl.settings import read_settings


def plan_of(config: Path | None, given: dict[str, Any], assignments: Sequence[str] = ()) -> RunPlan:
    """The plan that a file and a command line lead to."""
    return read_settings(config, given, assignments).plan()


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return tmp_path / "run.toml"


@pytest.mark.parametrize("where", ["file", "set", "option"])
def test_whatever_is_said_lies_over_the_preset(config: Path, where: str) -> None:
    """A preset is where options begin, wherever it is named: FDK's presets are windows, and window is an option too."""
    config.write_text("method = 'fdk'\n" + ("preset = 'hann'\n" if where == "file" else ""))
    named = {"preset": "hann" if where == "option" else None}
    preset = ["preset=hann"] if where == "set" else []
    assert plan_of(config, named, preset).options.window == "hann"
    assert plan_of(config, named, [*preset, "window=cosine"]).options.window == "cosine"
    config.write_text(config.read_text() + "window = 'hamming'\n")
    assert plan_of(config, named, preset).options.window == "hamming"
    assert plan_of(config, named, [*preset, "window=cosine"]).options.window == "cosine"


def test_a_named_option_wins_over_set_and_set_over_the_file(config: Path) -> None:
    config.write_text("iterations = 1\nseed = 1\npreset = 'paper'\nmethod = 'phyradgs'\n")
    found = plan_of(config, {"iterations": None}, [])
    assert (found.options.iterations, found.options.gaussians, found.seed) == (1, 50_000, 1)
    assert plan_of(config, {}, ["iterations=2"]).options.iterations == 2
    found = plan_of(config, {"iterations": 3, "seed": 3}, ["iterations=2", "seed=2"])
    assert (found.options.iterations, found.seed) == (3, 3)
    assert plan_of(config, {"preset": "default"}, ["preset=paper"]).options.gaussians == 0


@pytest.mark.parametrize(
    ("text", "error"),
    [
        *((f"iterations = {value}", "iterations: ") for value in ("'many'", f"0x{'f' * 5000}")),
        ("strips = true", "strips: "), ("motion = 'wobble'", "motion: "), ("method = ['fdk']", "method: "),
        ("seed = 2024-01-01", "seed: "), ("device = [0]", "device: "), ("voxel_mm = [1, 2]", "voxel_mm: "),
        ("preset = ['default']", "preset: "), ("size = '4,4,4'", "size: "), ("method = 'phyradgs'\nrates = 3", "rates: "),
        ("method = 'phyradgs'\n[rates]\nposition = [nan, 1e-4]", "rates.position: "),
        ("method = 'phyradgs'\n[control]\nthreshold = -1", "control.threshold: "),
        ("method = 'phyradgs'\n[control]\nevry = 3", "control.evry: found no such option of --method phyradgs"),
        ("method = 'fdk'\nstrips = 3", "strips: found --motion per-row for --method fdk"),
        (f"iterations = {'9' * 5000}", ""), ("a = " + "[" * 20_000, ""),
    ],
)  # fmt: skip
def test_a_wrong_value_of_a_file_is_named_by_its_line(config: Path, text: str, error: str) -> None:
    config.write_text(text)
    with pytest.raises(InputError, match=re.escape(f"config {config}: {error}" if error else str(config))):
        plan_of(config, {})


def test_a_wrong_option_is_named_where_it_stands_and_who_has_it(config: Path) -> None:
    config.write_text("method = 'fdk'\niterations = 3\n")
    assert plan_of(None, {"prior": "tv"}, ["prior=dct"]).options.prior == "tv"
    for given, assignments, words in (
        ((config, {"iterations": 5}), [], "^--iterations: found no such option of --method fdk"),
        ((None, {"method": "fdk"}), ["iterations=5"], "^--set iterations=5: found no such option of --method fdk"),
        ((None, {"prior": "tv", "method": "sirt"}), [], "^--prior: .* of --method sirt.*fista or moving has it$"),
        ((None, {"method": "sirt"}), ["noise_stop=1.1"], "1.1: .*; --method sart or os-sart or cgls or asd-pocs has it$"),
    ):
        with pytest.raises(InputError, match=words):
            plan_of(*given, assignments)
