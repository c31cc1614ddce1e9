"""The scripts in examples/: short, run as they stand, and shown in the documentation as they are."""

import ast
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from phyradgs_cl import api

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
LACKING = [name for name in ("torch", "deepinv") if importlib.util.find_spec(name) is None]  # `make test-neural` has both
RUN = [
    path for path in EXAMPLES if not any(f"import {name}\n" in path.read_text(encoding="utf-8") for name in LACKING)
]
MOST_LINES, LONGEST_S = 60, 300  # under a minute on two cores that have nothing else to do
SAID = {
    "deepinv_physics": r"FISTA of deepinv: (?P<more>2\d\.\d+) dB",
    "own_arrays": r"still: (?P<less>[\d.]+) dB.*\nmoving: (?P<more>[\d.]+) dB",
    "own_motion": r"readout takes 0\.86 of an exposure\nlevel: (?P<more>[\d.]+) dB\nsagging: (?P<less>[\d.]+) dB\nPoseTable",
    "own_poses": r"stated: (?P<less>[\d.]+) dB\nfound: (?P<more>[\d.]+) dB\ncalibrated: ",
    "sweep_in_python": r"PSNR \(dB\) +15 views +30 views[\s\S]*fista-tv +(?P<more>[\d.]+)",
    "from_tigre_or_astra": r"largest difference [\d.e-]+\n(?P<more>2\d\.\d) dB to the truth",
}


@pytest.mark.parametrize("path", RUN, ids=lambda path: path.stem)
def test_an_example_runs_as_it_stands(tmp_path, path) -> None:
    done = subprocess.run(
        [sys.executable, str(path)], cwd=tmp_path, capture_output=True, text=True, timeout=LONGEST_S, check=False
    )
    assert done.returncode == 0, done.stderr
    if path.stem in SAID:
        found = re.search(SAID[path.stem], done.stdout)
        assert found, done.stdout
        numbers = {name: float(value) for name, value in found.groupdict().items()}
        assert numbers.get("less", 0.0) < numbers["more"]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_in_the_documentation_as_it_is(path) -> None:
    page = (ROOT / "docs" / "reference" / "examples.md").read_text(encoding="utf-8")
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MOST_LINES
    assert text in page, "run docs/make_reference.py"


def imports(tree: ast.AST) -> set[str]:
    """The modules of ours that are imported, and what else is, by its first name."""
    found = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    found |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    return {name if name.startswith("phyradgs_cl") else name.partition(".")[0] for name in found}


def test_nothing_but_the_api_is_imported() -> None:
    """The examples, the tutorial's scripts and the notebook: users need no inner room."""
    first = imports(ast.parse((ROOT / "examples" / "own_arrays.py").read_text(encoding="utf-8")))
    assert first == {"numpy", "phyradgs_cl.api"}
    tutorial = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    scripts = [path.read_text(encoding="utf-8") for path in EXAMPLES]
    scripts += re.findall(r"cat > \w+\.py <<'END'\n(.*?)\nEND\n", tutorial, re.S) + cells()
    for script in scripts:
        ours = {name for name in imports(ast.parse(script)) if name.startswith("phyradgs_cl")}
        assert ours <= {"phyradgs_cl.api"}, script[:200]


def cells() -> list[str]:
    """The notebook's cells of Python.

    They are executed here, in one process: a kernel and its client are some thirty packages, and show nothing more.
    """
    notebook = json.loads((ROOT / "docs" / "tutorial.ipynb").read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["metadata"]["kernelspec"]["language"]) == (4, "python")
    for cell in notebook["cells"]:
        assert set(cell) >= {"id", "cell_type", "metadata", "source"}
        assert cell["cell_type"] == "markdown" or (cell["outputs"], cell["execution_count"]) == ([], None)
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


SMALLER = {r"size=\d+": "size=16", r"detector=\d+": "detector=24", r"iterations=\d+": "iterations=20"}


def test_the_notebook_runs_from_top_to_bottom(tmp_path, monkeypatch) -> None:
    from matplotlib.figure import Figure

    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    shown = []
    for number, cell in enumerate(cells()):
        for pattern, replacement in SMALLER.items():
            cell = re.sub(pattern, replacement, cell)
        tree = ast.parse(cell, f"cell {number}")
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, f"cell {number}", "exec"), names)
        if last is not None:
            shown.append(eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names))
    assert sum(isinstance(value, Figure) for value in shown) >= 3
    assert isinstance(names["moving"], api.Reconstruction) and (tmp_path / "moving.h5").exists()
