"""The tutorial runs from top to bottom as it stands, but on small scans: every command, script and file of it."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from phyradgs_cl.__main__ import load_cli

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
PIXELS = 32
SMALLER = {
    r"--size \d+": "--size 16", r"--detector \d+": f"--detector {PIXELS}", r"--iterations \d+": "--iterations 20",
    r"(reconstruct \w+\.h5(?: --motion static)?) -o": r"\1 --iterations 20 -o",
    r"iterations = \d+": "iterations = 20", r"iterations=\d+": "iterations=20", r"96j": "32j",
    r"Grid\.cube\(64": "Grid.cube(16", r"\[64, 64, 64\]": "[16, 16, 16]", r"4 / 128": f"4 / {PIXELS}",
    r"= 0\.03125": f"= {4 / PIXELS}",
}  # fmt: skip
SHELL = ("python3 -m venv", ". ~", "pip install", "mkdir")  # what makes an environment


def steps(text: str) -> Iterator[tuple[str, str]]:
    """(command, "") of every command line in the page's shell blocks, ("cat > FILE", content) of its files."""
    for block in re.findall(r"```sh\n(.*?)```", text, re.S):
        whole = block.replace("\\\n", " ")
        for file, content, command in re.findall(r"^(?:cat > (\S+) <<'END'\n(.*?\n)END|(\S[^\n]*))$", whole, re.S | re.M):
            yield (f"cat > {file}", content) if file else (command, "")


def smaller(text: str) -> str:
    for pattern, replacement in SMALLER.items():
        text = re.sub(pattern, replacement, text)
    return text


def run(command: str, content: str) -> None:
    words = shlex.split(command)
    if words[0] == "cat":
        Path(words[2]).write_text(content, encoding="utf-8")
    elif words[0] == "python":
        exec(compile(Path(words[1]).read_text(encoding="utf-8"), words[1], "exec"), {})
    elif words[0] == "phyradgs":
        assert load_cli().run(words[1:]) in ((0, 10) if words[1] == "check" else (0,)), command
    else:
        assert command.startswith(SHELL), f"the test does not know what to do with {command}"


def test_every_output_that_is_named_is_there(tmp_path, monkeypatch, fast_pictures) -> None:
    monkeypatch.chdir(tmp_path)
    for command, content in steps(smaller(TEXT)):
        run(command, content)
    commands = [command for command, _ in steps(TEXT)]
    named = [m[1] for command in commands if (m := re.search(r" -o (\S+)", command))]
    assert len(named) > 15 and not [name for name in named if not (tmp_path / name).exists()]
