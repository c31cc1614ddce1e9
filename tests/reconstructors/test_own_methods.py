"""A method of somebody's own: a function, by itself or by its name, wherever a method is asked for."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.api import (
    MicroViews,
    Motion,
    Progress,
    Reconstruction,
    Static,
    load_volume,
    ray_operator,
    reconstruct,
)
from phyradgs_cl.errors import InputError, NumericalError

pytestmark = pytest.mark.slow

TINY = ["--phantom", "jaw", "--size", "8", "--detector", "12", "--views", "4", "--time-samples", "2"]
MODULE = '''
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.api import Motion, Static, ray_operator


@dataclass(frozen=True)
class Options:
    motion: Motion = Static()
    gain: float = 0.25
    steps: int = 3


def back(scan, options: Options, rt):
    """Plain backprojection."""
    return options.gain * ray_operator(scan, options.motion, device=rt).T(scan.projections)
'''


@dataclass(frozen=True)
class Options:
    motion: Motion = Static()
    gain: float = 2.0
    steps: int = 3


@pytest.fixture(scope="module")
def scan(rt):
    from phyradgs_cl.api import simulate

    return simulate("jaw", size=8, detector=12, views=4, device=rt)


@pytest.fixture
def module(tmp_path, monkeypatch) -> Path:
    """A folder with a method's module, in which one has just started."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(
        str(tmp_path)
    )  # undone with the test; imported() finds it by the present folder too
    (tmp_path / "my_methods.py").write_text(MODULE)
    return tmp_path


def test_a_function_is_run_with_its_options_and_what_it_takes(rt, scan) -> None:
    seen = []

    def landweber(scan, options: Options, rt, *, seed, report):
        seen.append((options, seed))
        for step in range(options.steps):
            report(Progress(step + 1, options.steps, 1.0, 0, 0.1))
        return Reconstruction(
            np.full(scan.grid.shape, options.gain, np.float32), scan.grid, facts={"steps": options.steps}
        )

    reports = []
    result = reconstruct(
        scan, landweber, gain=0.5, motion="micro-views", strips=2, seed=4, report=reports.append, device=rt
    )
    assert seen == [(Options(MicroViews(2, 5), 0.5), 4)] and [p.iteration for p in reports] == [1, 2, 3]
    assert result.volume.max() == 0.5 and result.facts["steps"] == 3
    assert result.facts["method"].endswith("landweber") and result.facts["options"]["motion"]["strips"] == 2
    with pytest.raises(InputError, match="did you mean 'gain'"):
        reconstruct(scan, landweber, gian=0.5, device=rt)


def test_an_array_is_a_result_and_options_need_no_class(rt, scan) -> None:
    def back(scan, options, rt):
        return ray_operator(scan, options.motion, device=rt).T(scan.projections)

    still, moving = (reconstruct(scan, back, motion=motion, device=rt) for motion in ("static", "per-row"))
    assert still.volume.dtype == np.float32 and np.any(still.volume != moving.volume)
    on_part = reconstruct(scan, back, size=6, device=rt)
    assert on_part.volume.shape == (6, 6, 6)


@dataclass(frozen=True)
class Unset:
    gain: float


@dataclass(frozen=True)
class Picky:
    gain: float = 1.0

    def __post_init__(self) -> None:
        if self.gain < 0:
            raise ValueError("gain below 0")


def of(options):
    """A method with these options' class that gives NaN."""

    def method(scan, options, rt):
        return np.full(scan.grid.shape, np.nan)

    method.__annotations__["options"] = options
    return method


@pytest.mark.parametrize(
    ("method", "options", "error", "words"),
    [
        (of(Unset), {}, InputError, "options that all have a default"),
        (of(Picky), {"gain": -1.0}, InputError, "gain below 0"),
        (of(Picky), {}, NumericalError, "NaN or infinity"),
        ("math:pi", {}, InputError, "found 3.14"),
    ],
)
def test_what_is_no_method_is_named(rt, scan, method, options, error, words) -> None:
    with pytest.raises(error, match=words) as raised:
        reconstruct(scan, method, device=rt, **options)
    assert str(raised.value).startswith("method")


def test_the_command_line_takes_it_wherever_it_takes_a_method(cli, simulated, module, capsys) -> None:
    scan, name = simulated(*TINY), "my_methods:back"
    run = ["--method", name, "--motion", "per-row", "--set", "gain=0.5"]
    assert cli.run(["reconstruct", str(scan), *run, "-o", "v.h5"]) == 0
    facts = load_volume("v.h5").facts
    assert (
        facts["method"] == name
        and facts["options"]["gain"] == 0.5
        and facts["options"]["motion"]["name"] == "per-row"
    )
    both = ["--set", "steps=7", "--set", "holdout=3"]  # its own goes before the frames' steps
    assert cli.run(["reconstruct", str(scan), *run, *both, "-o", "v.h5"]) == 0
    facts = load_volume("v.h5").facts
    assert facts["options"]["steps"] == 7 and facts["input"] == {"ignore_lag": False, "holdout": 3.0}
    assert cli.run(["reconstruct", str(scan), *run, "--steps", "sparks", "-o", "v.h5"]) == 0
    facts = load_volume("v.h5").facts
    assert facts["options"]["steps"] == 3 and facts["input"]["steps"] == "sparks"
    assert cli.run(["estimate", str(scan), *run]) == 0
    assert cli.run(["info", "v.h5"]) == 0 and cli.run(["report", "v.h5", "-o", "page.html"]) == 0
    (module / "c.toml").write_text(f'method = "{name}"\ngain = 0.125\n')
    assert cli.run(["reconstruct", str(scan), "--config", "c.toml", "-o", "w.h5"]) == 0
    np.testing.assert_allclose(load_volume("w.h5").facts["options"]["gain"], 0.125)
    (module / "g.toml").write_text(
        f'scans = ["{scan}"]\n[options]\nmethod = "{name}"\n[[grid]]\ngain = [0.1, 0.2]\nsteps = [5]\n'
    )
    capsys.readouterr()
    assert cli.run(["sweep", "g.toml", "-o", "swept"]) == 0
    lines = [json.loads(line) for line in (module / "swept" / "results.jsonl").read_text().splitlines()]
    assert [line["method"] for line in lines] == [name, name] and len(
        {line["metrics"]["psnr_db"] for line in lines}
    ) == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--method", "my_methods:nothing"], "expected a function nothing in my_methods"),
        (["--method", "not_there:back"], "No module named 'not_there'"),
        (
            ["--method", "my_methods:back", "--set", "gian=3"],
            "--set gian=3: found no such option of --method my_methods:back",
        ),
        (["--method", "my_methods:back", "--resume"], "--resume: found --method my_methods:back"),
        (["--method", "my_methods"], "or package.module:function of your own"),
    ],
)
def test_the_command_line_says_what_is_wrong_in_one_line(cli, simulated, module, capsys, words, said) -> None:
    scan = simulated(*TINY)
    capsys.readouterr()  # the simulation's progress, where this test is the first with the scan
    assert cli.run(["reconstruct", str(scan), *words, "-o", "v.h5"]) == 2
    complaint = capsys.readouterr().err
    assert said in complaint and complaint.count("\n") == 1 and not Path("v.h5").exists()
