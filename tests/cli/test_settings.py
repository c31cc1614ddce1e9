"""What wins over what, and how a wrong value is named by the place where it stands."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors import method_options
from phyradgs_cl.settings import RunSettings, run_settings


def options_of(settings: RunSettings) -> Any:
    """The method's options that the settings lead to."""
    return method_options(settings.method, settings.preset, settings.changes)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    return tmp_path / "run.toml"


@pytest.mark.parametrize("where", ["file", "set", "option"])
def test_whatever_is_said_lies_over_the_preset(config: Path, where: str) -> None:
    """A preset is where options begin, wherever it is named: FDK's presets are windows, and window is an option too."""
    config.write_text("method = 'fdk'\n" + ("preset = 'hann'\n" if where == "file" else ""))
    named = {"preset": "hann" if where == "option" else None}
    preset = ["preset=hann"] if where == "set" else []
    assert options_of(run_settings(config, named, preset)).window == "hann"
    assert options_of(run_settings(config, named, [*preset, "window=cosine"])).window == "cosine"
    config.write_text(config.read_text() + "window = 'hamming'\n")
    assert options_of(run_settings(config, named, preset)).window == "hamming"
    assert options_of(run_settings(config, named, [*preset, "window=cosine"])).window == "cosine"


def test_a_named_option_wins_over_set_and_set_over_the_file(config: Path) -> None:
    config.write_text("iterations = 1\nseed = 1\npreset = 'paper'\nmethod = 'phyradgs'\n")
    found = run_settings(config, {"iterations": None}, [])
    assert (options_of(found).iterations, options_of(found).gaussians, found.seed) == (1, 50_000, 1)
    assert options_of(run_settings(config, {}, ["iterations=2"])).iterations == 2
    found = run_settings(config, {"iterations": 3, "seed": 3}, ["iterations=2", "seed=2"])
    assert (options_of(found).iterations, found.seed) == (3, 3)
    assert options_of(run_settings(config, {"preset": "default"}, ["preset=released"])).ssim_weight == 0.2


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("iterations = 'many'", "iterations: found 'many'; expected a whole number"),
        ("strips = 2.5", "strips: found 2.5"),
        ("motion = 'wobble'", "motion: found 'wobble'"),
        ("method = 'magic'", "method: found 'magic'"),
        ("seed = 1.5", "seed: found 1.5; expected a whole number"),
        ("device = -1", "device: found -1"),
        ("median_filter = 4", "median_filter: found 4"),
        ("[control]\nthreshold = -1", "control.threshold: found -1.0"),
        ("[control]\nevry = 3", "control.evry: found no such option of --method phyradgs"),
        ("method = 'fdk'\nwindow = 'round'", "window: found 'round'"),
        ("method = 'fdk'\nstrips = 3", "strips: found --motion static for --method fdk"),
    ],
)
def test_a_wrong_value_of_a_file_is_named_by_its_line(config: Path, text: str, error: str) -> None:
    config.write_text(text)
    with pytest.raises(InputError, match=re.escape(f"config {config}: {error}")):
        run_settings(config, {})


def test_a_wrong_option_of_the_command_line_is_not_the_files(config: Path) -> None:
    config.write_text("method = 'fdk'\niterations = 3\n")
    with pytest.raises(InputError, match="^--iterations: found no such option of --method fdk"):
        run_settings(config, {"iterations": 5})
    with pytest.raises(InputError, match="^--set iterations=5: found no such option of --method fdk"):
        run_settings(None, {"method": "fdk"}, ["iterations=5"])


def test_a_grid_and_a_method_in_any_case(config: Path) -> None:
    config.write_text("method = 'FISTA-TV'\nsize = [8, 9, 10]\n")
    found = run_settings(config, {"size": None, "voxel_mm": (0.5, 0.5, 0.5)})
    assert (found.method, found.before.size, found.before.voxel_mm) == ("fista-tv", (8, 9, 10), (0.5,) * 3)
    found = run_settings(config, {"size": 7.0, "method": "Sirt"})
    assert (found.method, found.before.size) == ("sirt", 7)


def test_a_method_offers_only_what_it_has() -> None:
    for method, offered in (("fdk", "window, motion"), ("sart", "motion, strips, sub_intervals")):
        with pytest.raises(InputError) as caught:
            method_options(method, None, {"length": 1})
        assert caught.value.expected.endswith(offered)
