"""The documentation keeps up with the code: every option is there, and the worked example works."""

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import typer

from phyradgs_cl import api
from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.reconstructors import METHODS, method_options, plan_run, reconstruct

pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parent.parent / "docs"


def option_names(options: Any, prefix: str = "") -> Iterator[str]:
    """Names as --set takes them; the motion's are described on their own."""
    for field in fields(options):
        value = getattr(options, field.name)
        if field.name == "motion":
            yield from ("strips", "sub_intervals", "segments", "time_error")
        elif is_dataclass(value):
            yield from option_names(value, f"{field.name}.")
        else:
            yield prefix + field.name


def test_every_option_and_preset_is_described() -> None:
    text = (DOCS / "methods.md").read_text(encoding="utf-8")
    for method, entry in METHODS.items():
        names = (method, *entry.presets, *option_names(method_options(method)))
        missing = [name for name in names if f"`{name}`" not in text]
        assert not missing, f"docs/methods.md does not describe {missing} of {method}"


def test_the_worked_example_of_a_method_works(rt, monkeypatch) -> None:
    scan = api.simulate("jaw", size=12, detector=16, views=8, exposure_deg=45.0, device=rt)
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "methods.md").read_text(encoding="utf-8"), re.S)
    source, module = next(b for b in blocks if "class Landweber(" in b), ModuleType("landweber_of_the_docs")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(source, "docs/methods.md", "exec"), module.__dict__)
    monkeypatch.setitem(METHODS, "landweber", module.METHOD)
    plans = [plan_run("landweber", {"motion": motion, "iterations": 40, "step": 1.5}) for motion in ("static", "per-row")]
    static, fly = (reconstruct(scan, plan, rt) for plan in plans)
    residuals = [line["residual"] for line in fly.record]
    assert residuals[-1] < 0.5 * residuals[0]
    errors = [np.linalg.norm(found.volume - scan.reference) for found in (fly, static)]
    assert errors[0] < errors[1]


def test_the_reference_names_every_command_option_and_public_name() -> None:
    """Made by docs/make_reference.py; how a help text is broken into lines is Typer's business."""
    cli = (DOCS / "reference" / "cli.md").read_text(encoding="utf-8")
    group = typer.main.get_command(load_cli().app)
    for name, command in group.commands.items():
        section = cli.split(f"## phyradgs {name}\n")[1].split("\n## ")[0]
        for parameter in command.params:
            is_named = parameter.param_type_name == "argument" and parameter.metavar
            for option in [parameter.metavar] if is_named else parameter.opts:
                assert option in section, f"phyradgs {name}: {option}: run docs/make_reference.py"
    text = (DOCS / "reference" / "api.md").read_text(encoding="utf-8")
    for name in api.__all__:
        assert f"## {name}\n" in text, f"{name}: run docs/make_reference.py"


def test_the_site_builds_without_a_broken_link(tmp_path) -> None:
    """Strictly: a link, an anchor or a page that is nowhere ends the build."""
    root = DOCS.parent
    arguments = ["build", "--strict", "--config-file", str(root / "mkdocs.yml")]  # --quiet hides warnings from --strict
    command = [sys.executable, "-m", "mkdocs", *arguments, "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "mathematics" / "index.html").read_text(encoding="utf-8")
    assert page.count("<math") > 150 and "$$" not in page
    options = (tmp_path / "site" / "cli" / "index.html").read_text(encoding="utf-8")
    assert "<code>--noise none|tigre|beer</code>" in options  # written with \\| in the Markdown


def test_tables_of_the_results_are_those_of_the_recorded_runs() -> None:
    command = [sys.executable, str(DOCS / "make_results.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"run docs/make_results.py: {done.stdout}{done.stderr}"
