"""The scripts in examples/: short, run as they stand, and shown in the documentation as they are."""

import ast
import importlib.util
import json
import os
import re
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from phyradgs_cl import api

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
LACKING = [name for name in ("torch", "deepinv") if importlib.util.find_spec(name) is None]  # `make test-neural` has both
SERVICE = ROOT / "examples" / "watch_folder.py"
LEFT_OUT = [SERVICE, *(p for p in EXAMPLES if any(f"import {name}\n" in p.read_text(encoding="utf-8") for name in LACKING))]
RUN = [path for path in EXAMPLES if path not in LEFT_OUT]
LONGEST_S = 300  # under a minute on two cores that have nothing else to do
SAID = {
    "deepinv_physics": r"FISTA of deepinv: (?P<more>2\d\.\d+) dB",
    "own_arrays": r"still: (?P<less>[\d.]+) dB.*\nmoving: (?P<more>[\d.]+) dB",
    "own_motion": r"readout takes 0\.86 of an exposure\nlevel: (?P<more>[\d.]+) dB\nsagging: (?P<less>[\d.]+) dB\nPoseTable",
    "own_poses": r"stated: (?P<less>[\d.]+) dB\nfound: (?P<more>[\d.]+) dB\ncalibrated: ",
    "sweep_in_python": r"PSNR \(dB\) +15 views +30 views[\s\S]*fista-tv +(?P<more>[\d.]+)",
    "from_tigre_or_astra": r"largest difference [\d.e-]+\n(?P<more>3\d\.\d) dB to the truth",
}
FEWER = {
    "own_poses": {"views=30, exposure_deg=6.0": "views=18, exposure_deg=10.0"},
    "own_arrays": {"iterations=30": "iterations=15"},
    "own_sirt": {"size=32, detector=48": "size=16, detector=24", "else 50": "else 10"},
    "sweep_in_python": {'"iterations": 40': '"iterations": 15', '"iterations": 30': '"iterations": 12'},
}


@pytest.mark.parametrize("path", RUN, ids=lambda path: path.stem)
def test_an_example_runs_as_it_stands(tmp_path, monkeypatch, capsys, path) -> None:
    """Those that take long with fewer views or iterations; all in this process, which has imported what they import."""
    text = path.read_text(encoding="utf-8")
    for many, fewer in FEWER.get(path.stem, {}).items():
        assert many in text
        text = text.replace(many, fewer)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [path.name])
    Path(path.name).write_text(text, encoding="utf-8")
    runpy.run_path(path.name, run_name="__main__")
    said = capsys.readouterr().out
    if path.stem in SAID:
        found = re.search(SAID[path.stem], said)
        assert found, said
        numbers = {name: float(value) for name, value in found.groupdict().items()}
        assert numbers.get("less", 0.0) < numbers["more"]


def test_the_service_makes_each_scan_once_and_goes_on_when_it_is_killed(tmp_path, tiny_scan) -> None:
    """A scan that is cut off fails, and is made when the rest of it has come."""
    incoming, volumes, log = tmp_path / "in", tmp_path / "out", tmp_path / "said.txt"
    incoming.mkdir()
    whole = tiny_scan.read_bytes()
    (incoming / "a.h5").write_bytes(whole[: len(whole) // 2])
    words = ["--method", "sirt", "--iterations", "250", "--checkpoint-every", "0.01"]
    command = [sys.executable, str(SERVICE), str(incoming), str(volumes), *words]

    def serve(*steps: tuple[Callable[[], object], Callable[[], bool]]) -> None:
        """Starts the service; in each step does something and waits for what the service does; then kills it."""
        with open(log, "a") as said, subprocess.Popen(command, stdout=said, stderr=said, start_new_session=True) as process:
            try:
                for act, is_so in steps:
                    act()
                    deadline = time.monotonic() + LONGEST_S
                    while not is_so():
                        assert process.poll() is None and time.monotonic() < deadline, log.read_text()
                        time.sleep(0.02)
            finally:
                os.killpg(process.pid, signal.SIGKILL)

    a, b, said_of_a = (volumes / name for name in ("a.h5", "b.h5", "a.log"))
    serve(
        (bool, lambda: said_of_a.exists() and "phyradgs: " in said_of_a.read_text() and not a.exists()),
        (lambda: (incoming / "a.h5").write_bytes(whole), lambda: a.exists() and "PSNR" in said_of_a.read_text()),
        (lambda: (incoming / "b.h5").write_bytes(whole), Path(f"{b}.checkpoint.npz").exists),
    )
    made_ns = a.stat().st_mtime_ns
    assert not b.exists()
    serve((bool, b.exists))
    assert a.stat().st_mtime_ns == made_ns and not list(volumes.glob("*.bak"))  # no run has begun anew


def test_nothing_but_the_api_is_imported() -> None:
    """The examples, the tutorial's scripts and the notebook: users need no inner room."""
    tutorial = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    scripts = [path.read_text(encoding="utf-8") for path in EXAMPLES]
    scripts += re.findall(r"cat > \w+\.py <<'END'\n(.*?)\nEND\n", tutorial, re.S) + cells()
    found = {room for script in scripts for room in re.findall(r"^\s*(?:from|import) (phyradgs_cl\S*)", script, re.M)}
    assert found == {"phyradgs_cl.api"}


def cells() -> list[str]:
    """The notebook's cells of Python, which are executed in one process: a kernel and its client are thirty packages."""
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
