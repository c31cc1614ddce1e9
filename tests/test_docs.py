"""The documentation keeps up with the code: every option is there, and the worked example works."""

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import h5py
import numpy as np
import pytest
import typer

from phyradgs_cl import api
from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.acquisition import ConeGeometry
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


def test_pages_and_docstrings_agree_on_integers_and_angles(cli, tmp_path) -> None:
    """What they say is what happens, and no other page says something else."""
    volume = np.full((4, 4, 4), 255, np.uint8)
    with h5py.File(tmp_path / "bare.h5", "w") as file:
        file["volume"] = volume
    page, tutorial, conventions = ((DOCS / f"{name}.md").read_text() for name in ("formats", "tutorial", "mathematics"))
    for scanner, words in {"r2": "1/mm with `r2`", "carm": "0.01/mm with `carm`"}.items():
        command = ["simulate", "--volume", str(tmp_path / "bare.h5"), "--scanner", scanner, "--size", "4"]
        assert cli.run([*command, "--detector", "6", "--views", "3", "-o", str(tmp_path / "scan.h5")]) == 0
        assert api.load_scan(tmp_path / "scan.h5").reference.max() == pytest.approx(float(words.partition("/")[0]))
        assert f" {words}" in " ".join(page.split())
    assert "(formats.md#volumes-of-other-programs)" in tutorial and "stands for 1 per mm" not in tutorial

    cone = ConeGeometry(5.0, 7.0, (2, 2), (0.2, 0.2))
    scan = api.fly_scan(np.zeros((2, 2, 2)), cone, [0.0, 90.0], exposure_deg=1.0)
    sources = [scan.trajectory.pose(frame, scan.frame_start_s[frame : frame + 1])[0, :3] for frame in (0, 1)]
    np.testing.assert_allclose(sources, [[5, 0, 0], [0, 5, 0]], atol=1e-12)
    assert "0 with the source on +x, counterclockwise" in " ".join(api.fly_scan.__doc__.split())
    (row,) = [line for line in conventions.splitlines() if line.startswith("| angles |")]
    assert "counterclockwise seen from $+z$; 0 with the source on $+x$" in row and "`_deg`" in row and "Python" not in row


def test_the_worked_example_of_a_method_works(rt, monkeypatch) -> None:
    scan = api.simulate("jaw", size=12, detector=16, views=8, exposure_deg=45.0, device=rt)
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "methods.md").read_text(encoding="utf-8"), re.S)
    source = next(b for b in blocks if "class Landweber(" in b)
    module = ModuleType("landweber_of_the_docs")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(source, "docs/methods.md", "exec"), module.__dict__)
    monkeypatch.setitem(METHODS, "landweber", module.METHOD)
    changes = {"iterations": 40, "step": 1.5}
    static, fly = (
        reconstruct(scan, plan_run("landweber", {"motion": motion, **changes}), rt)
        for motion in ("static", "per-row")
    )
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
    cells = re.compile(r"\.wy-table-responsive table td,\s*\.wy-table-responsive table th\s*{\s*white-space:\s*(\w+)")
    styles = re.findall(r'href="\.\./([^"?]+\.css)', options)
    rules = [cells.findall((tmp_path / "site" / style).read_text(encoding="utf-8")) for style in styles]
    assert sum(rules, [])[0] == "nowrap", "the theme's own rule has another form: look whether tables wrap"
    assert sum(rules, [])[-1] == "normal", "tables are wider than their column"
