"""Commands, options and values that have left: one line says what to write instead."""

import pytest

from phyradgs_cl.removed import REMOVED

pytestmark = pytest.mark.slow

FLAGS = [("reconstruct", flag) for flag in ("--tune", "--median-filter")]
FLAGS += [("simulate", flag) for flag in ("--readout", "--readout-direction", "--readout-ratio")]
FLAGS += [("import", flag) for flag in ("--readout", "--readout-direction", "--readout-s", "--frame-time-s")]
FLAGS += [("sweep", "--scheduler")]


def commands(word: str) -> list[list[str]]:
    """What a user of an earlier version writes."""
    if word.startswith("phyradgs "):
        return [[word.split()[1], *more] for more in ([], ["scan.h5", "-o", "volume.h5"], ["--help"])]
    if word.startswith("--what "):
        return [["calibrate", "scan.h5", *word.split(), "-o", "c.h5"]]
    value, _, option = word.rpartition(": option ")
    told = word.split() if word.startswith("--") and not value else [*value.split(), "--set", f"{option}=1"]
    flags = [one for one in FLAGS if one[1][2:].replace("-", "_") == word]
    words = [[command, "scan.h5", "-o", "volume.h5", flag, "3"] for command, flag in flags]
    return words if word == "scheduler" else [*words, ["reconstruct", "scan.h5", "-o", "volume.h5", *told]]


@pytest.mark.parametrize("word", [word for word in REMOVED if not word.startswith("fly_scan.")])
def test_a_word_that_left_names_its_replacement(cli, scan, capsys, word) -> None:
    for words in commands(word):
        assert cli.run([str(scan) if word == "scan.h5" else word for word in words]) == 2, words
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and error.endswith(f"{REMOVED[word]}\n"), error


@pytest.mark.parametrize("name", ["own-times", "static-start"])
def test_a_motion_that_left_is_named_in_a_file_too(cli, capsys, tmp_path, name) -> None:
    (tmp_path / "run.toml").write_text(f"motion = '{name}'\n")
    assert cli.run(["reconstruct", "scan.h5", "-o", "volume.h5", "--config", str(tmp_path / "run.toml")]) == 2
    error = capsys.readouterr().err
    assert "run.toml: motion" in error and error.endswith(f"{REMOVED[f'--motion {name}']}\n")
