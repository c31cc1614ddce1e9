"""The help as a manual page: every command in the list with its whole sentence, and the Tab key."""

import re
import sys

import pytest
import typer

from phyradgs_cl.acquisition import MOTIONS
from phyradgs_cl.phantoms import PHANTOMS
from phyradgs_cl.reconstructors import DEFAULT_METHOD, method_options

pytestmark = pytest.mark.slow


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
    commands, whole = typer.main.get_command(cli.app).commands, told("--help")
    lines = whole.split("Commands:\n")[1].splitlines()
    assert [line.split()[0] for line in lines] == list(commands)
    assert all(line.endswith(".") and "..." not in line for line in lines)
    assert whole == told("-h") == told() and "-h, --help" in whole
    texts = {name: told(name, "-h") for name in commands}
    assert told("info", "--help") == texts["info"]
    for name, command in commands.items():
        text = texts[name]
        assert "-h, --help" in text and f"Example: phyradgs {name}" in text
        assert not re.search(r"<(str|int|float|list|path)\b", text, re.IGNORECASE), f"{name} shows a type of Python"
        for parameter in command.params:
            if parameter.param_type_name == "argument":
                assert parameter.metavar.isupper()
            assert getattr(parameter, "help", None), f"{name}: {parameter.name} says nothing"


def test_the_defaults_are_those_of_the_default_method(told) -> None:
    options, text = method_options(DEFAULT_METHOD, None, {}), " ".join(told("reconstruct", "-h").split())
    assert f"Defaults are those of {DEFAULT_METHOD}." in text
    shown = {"motion": options.motion.name, "iterations": options.iterations, "prior": options.prior}
    for name, value in {"method": DEFAULT_METHOD, **shown}.items():
        assert f"[default: ({value})]" in text.split(f" --{name} ")[1].split("  --")[0], name


def test_the_tab_key_in_bash(cli, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["phyradgs"])  # from both, Typer finds the program's name
    monkeypatch.setattr(sys.modules["__main__"], "__package__", "")
    monkeypatch.setenv("_PHYRADGS_COMPLETE", "complete_bash")
    monkeypatch.setattr(cli, "give_up_stdout", lambda: None)
    for words, expected in {
        "phyradgs re": {"reconstruct", "report"}, "phyradgs export v.h5 --to n": {"nii", "nrrd", "npy", "npz"},
        "phyradgs reconstruct s.h5 --motion ": {*MOTIONS} - {"own-times", "static-start"},
        "phyradgs simulate --phantom ": {*PHANTOMS}, "phyradgs check --fi": {"--fix-offset"},
    }.items():  # fmt: skip
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", str(words.count(" ")))
        capsys.readouterr()
        assert cli.run([]) == 0
        assert set(capsys.readouterr().out.split()) == expected, words
