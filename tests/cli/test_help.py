"""The help as a manual page: every command in the list with its whole sentence, and the Tab key."""

import os
import subprocess
import sys

import pytest
import typer

from phyradgs_cl.acquisition import MOTIONS
from phyradgs_cl.phantoms import PHANTOMS
from phyradgs_cl.prepare import DEFAULT_STEPS
from phyradgs_cl.reconstructors.voxels.priors import PRIORS

PROGRAM = "import sys; sys.argv[0] = 'phyradgs'; from phyradgs_cl.__main__ import main; sys.exit(main())"


@pytest.fixture
def told(cli, capsys):
    """(words...) → what the command prints."""

    def tell(*words: str) -> str:
        assert cli.run([*words]) == 0
        captured = capsys.readouterr()
        assert captured.err == ""
        return captured.out

    return tell


def test_help_is_whole_everywhere(cli, told, monkeypatch) -> None:
    """No sentence is cut, and arguments are named as the documentation names them."""
    monkeypatch.setenv("COLUMNS", "80")
    commands = typer.main.get_command(cli.app).commands
    whole = told("--help")
    lines = whole.split("Commands:\n")[1].splitlines()
    assert [line.split()[0] for line in lines] == list(commands)
    assert all(line.endswith(".") and "..." not in line for line in lines)
    assert whole == told("-h") == told() and "-h, --help" in whole
    for name, command in commands.items():
        text = told(name, "--help")
        assert text == told(name, "-h") and "-h, --help" in text and f"Example: phyradgs {name}" in text
        for parameter in command.params:
            if parameter.param_type_name == "argument" and name != "bench":  # which has a choice of words
                assert parameter.metavar.isupper()
            assert getattr(parameter, "help", None), f"{name}: {parameter.name} says nothing"
    for name in ("reconstruct", "estimate"):
        usual, at_the_end = told(name, "-h").split("Under mpiexec (docs: cluster.md):\n")
        assert "--batch" in at_the_end and "--batch" not in usual and "--help" in usual


def test_a_default_is_that_of_the_command(told) -> None:
    """`prepare` has steps that nobody asked for, `reconstruct` has none."""
    for name, default in {"prepare": DEFAULT_STEPS, "reconstruct": "none"}.items():
        steps = told(name, "-h").split("--steps ")[1].split(" --")[0]
        assert f"[default: ({default})]" in " ".join(steps.split()), steps


def test_the_priors_are_named(told) -> None:
    """In words of its own: what knows their names takes a moment to load."""
    text = " ".join(told("reconstruct", "-h").split("--prior ")[1].split(" --")[0].split())
    assert text.split("for fista: ")[1].split(";")[0].replace(" or ", ", ").split(", ") == [*PRIORS], text


def test_the_tab_key_in_bash() -> None:
    for words, expected in {
        "phyradgs re": {"reconstruct", "report"},
        "phyradgs export v.h5 --to n": {"nii", "nrrd", "npy", "npz"},
        "phyradgs check --fi": {"--fix-offset"},
        "phyradgs reconstruct s.h5 --motion ": {*MOTIONS},
        "phyradgs simulate --phantom ": {*PHANTOMS},
    }.items():
        asked = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
        command = [sys.executable, "-c", PROGRAM]
        environment = {**os.environ, **asked, "_PHYRADGS_COMPLETE": "complete_bash"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert set(done.stdout.split()) == expected, (words, done.stderr)
