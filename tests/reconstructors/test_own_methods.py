"""A method of somebody's own: a function, by itself or by its name, wherever a method is asked for."""

import json
from dataclasses import dataclass, make_dataclass
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl import api
from phyradgs_cl.api import MicroViews, Motion, Progress, Reconstruction, Static, load_volume, reconstruct
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
    return api.simulate("jaw", size=8, detector=12, views=4, device=rt)


@pytest.fixture
def module(tmp_path, monkeypatch) -> Path:
    """A folder with a method's module, in which one has just started."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))  # undone with the test; imported() finds it by the present folder too
    (tmp_path / "my_methods.py").write_text(MODULE)
    return tmp_path


def test_a_function_is_run_with_its_options_and_what_it_takes(rt, scan) -> None:
    seen = []

    def landweber(scan, options: Options, rt, *, seed, report):
        seen.append((options, seed))
        for step in range(options.steps):
            report(Progress(step + 1, options.steps, 1.0, 0, 0.1))
        volume = np.full(scan.grid.shape, options.gain, np.float32)
        return Reconstruction(volume, scan.grid, facts={"steps": options.steps})

    reports, given = [], {"gain": 0.5, "motion": "micro-views", "strips": 2}
    result = reconstruct(scan, landweber, **given, seed=4, report=reports.append, device=rt)
    assert seen == [(Options(MicroViews(2, 5), 0.5), 4)] and [p.iteration for p in reports] == [1, 2, 3]
    assert result.volume.max() == 0.5 and result.facts["steps"] == 3
    assert result.facts["method"].endswith("landweber") and result.facts["options"]["motion"]["strips"] == 2
    with pytest.raises(InputError, match="did you mean 'gain'"):
        reconstruct(scan, landweber, gian=0.5, device=rt)


def test_an_array_is_a_result_and_options_need_no_class(rt, scan) -> None:
    def back(scan, options, rt):
        return api.ray_operator(scan, options.motion, device=rt).T(scan.projections)

    still, moving = (reconstruct(scan, back, motion=motion, device=rt) for motion in ("static", "per-row"))
    assert still.volume.dtype == np.float32 and np.any(still.volume != moving.volume)
    assert reconstruct(scan, back, size=6, device=rt).volume.shape == (6, 6, 6)


@dataclass(frozen=True)
class Picky:
    gain: float = 1.0

    def __post_init__(self) -> None:
        if self.gain < 0:
            raise ValueError("gain below 0")


def of(options):
    """A method with these options' class that gives NaN."""
    method = lambda scan, options, rt: np.full(scan.grid.shape, np.nan)  # noqa: E731
    method.__annotations__["options"] = options
    return method


@pytest.mark.parametrize(("method", "options", "error", "words"), [
    (of(make_dataclass("Unset", ["gain"])), {}, InputError, "options that all have a default"),
    (of(Picky), {"gain": -1.0}, InputError, "gain below 0"), (of(Picky), {}, NumericalError, "NaN or infinity"),
    ("math:pi", {}, InputError, "found 3.14"),
])  # fmt: skip
def test_what_is_no_method_is_named(rt, scan, method, options, error, words) -> None:
    with pytest.raises(error, match=words) as raised:
        reconstruct(scan, method, device=rt, **options)
    assert str(raised.value).startswith("method")


def test_the_command_line_takes_it_wherever_it_takes_a_method(cli, simulated, module) -> None:
    scan, name = simulated(*TINY), "my_methods:back"
    run = ["--method", name, "--motion", "per-row", "--set", "gain=0.5"]
    (module / "c.toml").write_text(f'method = "{name}"\ngain = 0.125\nsteps = 3\nmotion = "per-row"\n')
    none = {"ignore_lag": False}
    for words, gain, steps, before in (
        (run, 0.5, 3, none), ([*run, "--steps", "sparks"], 0.5, 3, {"steps": "sparks"}),
        ([*run, "--set", "steps=7", "--set", "holdout=3"], 0.5, 7, {**none, "holdout": 3.0}),  # its own steps
        (["--config", "c.toml"], 0.125, 3, none),
    ):  # fmt: skip
        assert cli.run(["reconstruct", str(scan), *words, "-o", "v.h5"]) == 0
        facts = load_volume("v.h5").facts
        assert (facts["method"], facts["options"]["motion"]["name"]) == (name, "per-row")
        assert (facts["options"]["gain"], facts["options"]["steps"]) == (gain, steps)
        assert facts["input"] == facts["input"] | before
    for words in (["estimate", str(scan), *run], ["info", "v.h5"], ["report", "v.h5", "-o", "page.html"]):
        assert cli.run(words) == 0
    grid = f'scans = ["{scan}"]\n[options]\nmethod = "{name}"\n[[grid]]\ngain = [0.1, 0.2]\nsteps = [5]\n'
    (module / "g.toml").write_text(grid)
    assert cli.run(["sweep", "g.toml", "-o", "swept"]) == 0
    lines = [json.loads(line) for line in (module / "swept" / "results.jsonl").read_text().splitlines()]
    assert [line["method"] for line in lines] == [name, name]
    assert len({line["metrics"]["psnr_db"] for line in lines}) == 2


@pytest.mark.parametrize(("words", "said"), [
    (["my_methods:nothing"], "expected a function nothing in my_methods"),
    (["not_there:back"], "No module named 'not_there'"),
    (["my_methods:back", "--set", "gian=3"], "--set gian=3: found no such option of --method my_methods:back"),
    (["my_methods:back", "--resume"], "--resume: found --method my_methods:back"),
])  # fmt: skip
def test_the_command_line_says_what_is_wrong_in_one_line(refused, simulated, module, words, said) -> None:
    refused(["reconstruct", simulated(*TINY), "--method", *words, "-o", "v.h5"], said)
    assert not Path("v.h5").exists()
