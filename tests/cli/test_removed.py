"""Commands and options that have left: one line says what to write instead."""

import pytest

from phyradgs_cl.removed import REMOVED

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("word", [word for word in REMOVED if word.startswith("phyradgs ")])
def test_a_command_that_left_names_its_replacement(cli, capsys, word) -> None:
    for more in ([], ["scan.h5", "-o", "volume.h5"], ["--help"]):
        assert cli.run([*word.split()[1:], *more]) == 2
        errors = capsys.readouterr().err
        assert errors.count("\n") == 1 and word in errors and REMOVED[word] in errors


def test_an_option_that_left_names_its_replacement(cli, refused) -> None:
    refused(["sweep", "grid.toml", "-o", "out", "--scheduler", "tcp://a:1"], REMOVED["scheduler"])


@pytest.mark.parametrize("word", ["lag", "drift", "start"])
def test_a_parameter_that_left_names_its_replacement(cli, refused, scan, word) -> None:
    refused(["calibrate", scan, "--what", word, "-o", "c.h5"], REMOVED[f"--what {word}"])
