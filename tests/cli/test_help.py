"""The help as a manual page: every command in the list with its whole sentence, and the Tab key."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import typer

from phyradgs_cl.__main__ import load_cli

PROGRAM = "import sys; sys.argv[0] = 'phyradgs'; from phyradgs_cl.__main__ import main; sys.exit(main())"


@pytest.fixture(scope="module")
def commands() -> dict:
    return typer.main.get_command(load_cli().app).commands


def test_the_list_of_commands_cuts_no_sentence(capsys, commands, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert load_cli().run(["--help"]) == 0
    lines = capsys.readouterr().out.split("Commands:\n")[1].splitlines()
    assert [line.split()[0] for line in lines] == list(commands)
    assert all(line.endswith(".") and "..." not in line for line in lines)


def test_every_command_has_an_example_and_names_its_arguments_as_the_documentation_does(
    capsys, commands
) -> None:
    for name, command in commands.items():
        assert load_cli().run([name, "--help"]) == 0
        told = capsys.readouterr().out
        assert f"Example: phyradgs {name}" in told
        for parameter in command.params:
            if parameter.param_type_name == "argument" and name != "bench":  # which has a choice of words
                assert parameter.metavar.isupper()
            assert getattr(parameter, "help", None), f"{name}: {parameter.name} says nothing"


def test_a_short_form_everywhere_and_the_options_of_ranks_at_the_end(capsys, commands) -> None:
    for words in ([], *([name] for name in commands)):
        helps = []
        for option in ("-h", "--help"):
            assert load_cli().run([*words, option]) == 0
            helps.append(capsys.readouterr().out)
        assert helps[0] == helps[1] and "-h, --help" in helps[0]
    for name in ("reconstruct", "estimate"):
        assert load_cli().run([name, "-h"]) == 0
        usual, at_the_end = capsys.readouterr().out.split("Under mpiexec (docs: cluster.md):\n")
        assert "--batch" in at_the_end and "--batch" not in usual and "--help" in usual


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("phyradgs re", {"reconstruct", "report"}),
        ("phyradgs export v.h5 --to n", {"nii", "nrrd", "npy", "npz"}),
        ("phyradgs check --fi", {"--fix-offset"}),
    ],
)
def test_the_tab_key_in_bash(words, expected) -> None:
    asked = {"_PHYRADGS_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, **asked},
        capture_output=True,
        text=True,
        check=False,
    )
    assert set(done.stdout.split()) == expected, done.stderr
