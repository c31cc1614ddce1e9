"""The help as a manual page: every command in the list with its whole sentence, and the Tab key."""

import os
import subprocess
import sys

import pytest
import typer

from phyradgs_cl.acquisition import MOTIONS
from phyradgs_cl.phantoms import PHANTOMS
from phyradgs_cl.prepare import DEFAULT_STEPS
from phyradgs_cl.reconstructors import DEFAULT_METHOD, method_options
from phyradgs_cl.reconstructors.voxels.priors import PRIORS

pytestmark = pytest.mark.slow

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
            if parameter.param_type_name == "argument":
                assert parameter.metavar.isupper()
            assert getattr(parameter, "help", None), f"{name}: {parameter.name} says nothing"
    for name in ("reconstruct", "estimate"):
        usual, at_the_end = told(name, "-h").split("Under mpiexec (docs: cluster.md):\n")
        assert "--batch" in at_the_end and "--batch" not in usual and "--help" in usual


def test_options_that_commands_share_are_declared_once(cli) -> None:
    """All but what is written, a file or a folder, and a sweep's devices say the same in every command."""
    commands = typer.main.get_command(cli.app).commands
    help_of: dict[str, str] = {}
    for name in ("reconstruct", "estimate", "sweep"):
        for parameter in commands[name].params:
            is_own = parameter.name == "output" or (name, parameter.name) == ("sweep", "device")
            if parameter.param_type_name == "option" and not is_own:
                assert help_of.setdefault(parameter.name, parameter.help) == parameter.help, f"{name}: {parameter.name}"


def test_every_option_has_a_group_and_the_basics_fit_a_screen(cli, told, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    commands = typer.main.get_command(cli.app).commands
    for name in ("reconstruct", "import", "simulate"):
        command = commands[name]
        grouped = [parameter for names in command.groups.values() for parameter in names]
        options = [p.name for p in command.params if p.param_type_name == "option"]
        assert sorted(grouped) == sorted(options), f"{name}: each option once"
        headings = list(command.groups)
        assert headings[0] == "Basics" and len(command.groups["Basics"]) <= 10
        basics, rest = told(name, "-h").split(f"\n{headings[1]}:\n")
        lines = basics.split("\nBasics:\n")[1].splitlines()
        assert len(lines) <= 24 and lines[-1].startswith("  -h, --help"), f"{name}: {len(lines)} lines"
        assert all(f"\n{heading}:\n" in rest for heading in headings[2:])
    assert "Options:" not in told("reconstruct", "-h") + told("estimate", "-h")


def test_the_defaults_are_those_of_the_default_method(told) -> None:
    options = method_options(DEFAULT_METHOD, None, {})
    text = " ".join(told("reconstruct", "-h").split())
    assert f"Defaults are those of {DEFAULT_METHOD}." in text
    shown = {"motion": options.motion.name, "iterations": options.iterations, "prior": options.prior}
    for name, value in {"method": DEFAULT_METHOD, **shown}.items():
        assert f"[default: ({value})]" in text.split(f" --{name} ")[1].split(" --")[0], name


def test_a_default_is_that_of_the_command(told) -> None:
    """`prepare` has steps that nobody asked for, `reconstruct` has none."""
    for name, default in {"prepare": DEFAULT_STEPS, "reconstruct": "none"}.items():
        steps = told(name, "-h").split("--steps ")[1].split(" --")[0]
        assert f"[default: ({default})]" in " ".join(steps.split()), steps


def test_the_priors_are_named(told) -> None:
    text = " ".join(told("reconstruct", "-h").split("--prior ")[1].split(" --")[0].split())
    assert text.split("for fista: ")[1].split(";")[0].replace(" or ", ", ").split(", ") == [*PRIORS], text


def test_the_tab_key_in_bash() -> None:
    for words, expected in {
        "phyradgs re": {"reconstruct", "report"},
        "phyradgs export v.h5 --to n": {"nii", "nrrd", "npy", "npz"},
        "phyradgs check --fi": {"--fix-offset"},
        "phyradgs reconstruct s.h5 --motion ": {*MOTIONS} - {"own-times", "static-start"},
        "phyradgs simulate --phantom ": {*PHANTOMS},
    }.items():
        asked = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
        command = [sys.executable, "-c", PROGRAM]
        environment = {**os.environ, **asked, "_PHYRADGS_COMPLETE": "complete_bash"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert set(done.stdout.split()) == expected, (words, done.stderr)
