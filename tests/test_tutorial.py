"""The tutorial runs from top to bottom as it stands, but on small scans: every command, script and file of it."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.api import load_scan

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent
TEXT = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
PIXELS = 32
SMALLER = {
    r"--size \d+": "--size 16",
    r"--detector \d+": f"--detector {PIXELS}",
    r"--iterations \d+": "--iterations 20",
    r"(reconstruct \w+\.h5(?: --motion static)?) -o": r"\1 --iterations 20 -o",
    r"iterations = \d+": "iterations = 20",
    r"iterations=\d+": "iterations=20",
    r"96j": "32j",
    r"Grid\.cube\(64": "Grid.cube(16",
    r"\[64, 64, 64\]": "[16, 16, 16]",
    r"4 / 128": f"4 / {PIXELS}",
    r"= 0\.03125": f"= {4 / PIXELS}",
}
SHELL = ("python3 -m venv", ". ~", "pip install", "mkdir")  # what makes an environment


def steps(text: str) -> Iterator[tuple[str, str]]:
    """(command, "") of every command line in the page's shell blocks, ("cat > FILE", content) of its files."""
    for block in re.findall(r"```sh\n(.*?)```", text, re.S):
        whole = block.replace("\\\n", " ")
        for file, content, command in re.findall(
            r"^(?:cat > (\S+) <<'END'\n(.*?\n)END|(\S[^\n]*))$", whole, re.S | re.M
        ):
            yield (f"cat > {file}", content) if file else (command, "")


def smaller(text: str) -> str:
    for pattern, replacement in SMALLER.items():
        text = re.sub(pattern, replacement, text)
    return text


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where everything of the tutorial has been run."""
    folder = tmp_path_factory.mktemp("tutorial")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        # tests/metrics looks at what `evaluate` draws
        patch.setattr("phyradgs_cl.workflow.volumes.slices_png", lambda path, *_: Path(path).write_bytes(b"\x89PNG"))
        for command, content in steps(smaller(TEXT)):
            run(command, content)
    return folder


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


def test_every_output_that_is_named_is_there(folder) -> None:
    commands = [command for command, _ in steps(TEXT)]
    named = [m[1] for command in commands if (m := re.search(r" -o (\S+)", command))]
    assert len(named) > 15
    assert not [name for name in named if not (folder / name).exists()]


def test_a_folder_of_tiffs_becomes_the_scan_that_it_was_made_from(folder) -> None:
    made, imported = load_scan(folder / "scan.h5"), load_scan(folder / "imported.h5")
    assert imported.geometry == made.geometry and imported.shutter == made.shutter
    assert imported.grid == made.grid
    np.testing.assert_allclose(imported.frame_start_s, made.frame_start_s, atol=1e-9)
    np.testing.assert_allclose(imported.projections, made.projections, atol=0.01)  # 40,000 counts, 10 flats
    for frame in (0, 7):
        times_s = made.frame_start_s[frame] + np.linspace(0, 1.86, 4)
        poses = [scan.trajectory.pose(frame, times_s) for scan in (made, imported)]
        np.testing.assert_allclose(*poses, atol=1e-6)
