"""Options and values that have left: one line says what to write instead."""

import pytest

from phyradgs_cl.removed import REMOVED

pytestmark = pytest.mark.slow

WORDS = [word for word in REMOVED if not word.startswith(("phyradgs ", "fly_scan.", "--what "))]


@pytest.mark.parametrize("word", WORDS)
def test_a_word_that_left_names_its_replacement(cli, capsys, word) -> None:
    value, _, option = word.rpartition(": option ")
    told = word.split() if word.startswith("--") and not value else [*value.split(), "--set", f"{option}=1"]
    assert cli.run(["reconstruct", "scan.h5", "-o", "volume.h5", *told]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "earlier version" in error and error.endswith(f"{REMOVED[word]}\n")


@pytest.mark.parametrize("name", ["own-times", "static-start"])
def test_a_motion_that_left_is_named_in_a_file_too(cli, capsys, tmp_path, name) -> None:
    (tmp_path / "run.toml").write_text(f"motion = '{name}'\n")
    assert cli.run(["reconstruct", "scan.h5", "-o", "volume.h5", "--config", str(tmp_path / "run.toml")]) == 2
    error = capsys.readouterr().err
    assert "run.toml: motion" in error and error.endswith(f"{REMOVED[f'--motion {name}']}\n")


FLAGS = [("reconstruct", flag) for flag in ("--tune", "--median-filter")]
FLAGS += [("simulate", flag) for flag in ("--readout", "--readout-direction", "--readout-ratio")]
FLAGS += [("import", flag) for flag in ("--readout", "--readout-direction", "--readout-s", "--frame-time-s")]


@pytest.mark.parametrize(("command", "flag"), FLAGS)
def test_a_flag_that_left_names_its_replacement(cli, capsys, command, flag) -> None:
    assert cli.run([command, "scan.h5", "-o", "volume.h5", flag, "3"]) == 2
    assert capsys.readouterr().err.endswith(f"{REMOVED[flag[2:].replace('-', '_')]}\n")
