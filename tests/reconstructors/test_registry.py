"""Options by name: converted, checked, and refused with the names that would have been right."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from itertools import product
from typing import Any

import numpy as np
import pytest
from refusals import assert_refused

from phyradgs_cl import neural
from phyradgs_cl.__main__ import load_cli
from phyradgs_cl.acquisition import Exact, MicroViews, Scan, Static, TimeCells
from phyradgs_cl.api import save_scan, simulate
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors import METHODS, method_options, plan_run, reconstruct
from phyradgs_cl.reconstructors.plan import _models
from phyradgs_cl.reconstructors.voxels.sart import SirtOptions

ABSURD = {
    "NaN": float("nan"), "infinite": float("inf"), "huge": 1e300, "far below 0": -1e300, "boolean": True,
    "too long for a float": 10**400, "too long to print": 10**5000, "word": "many", "list": [[1]],
}  # fmt: skip


def numeric_options(options: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """(names from the outside in, present value) of every number and tuple of numbers in an options class."""
    for field in fields(options):
        value = getattr(options, field.name)
        if field.name == "motion" or isinstance(value, bool):
            continue
        if is_dataclass(value):
            yield from numeric_options(value, (*path, field.name))
        elif isinstance(value, int | float | tuple):
            yield (*path, field.name), value


def nested(path: tuple[str, ...], value: object) -> dict[str, Any]:
    """``value`` as a configuration file would give it: {"rates": {"position": value}}."""
    return {path[0]: nested(path[1:], value) if path[1:] else value}


BASES = {method: next(iter(entry.presets.values())) for method, entry in METHODS.items()}
NUMBERS = [(method, *number) for method, options in BASES.items() for number in numeric_options(options)]
MOTIONS = {method: tuple(_models(options)) for method, options in BASES.items()}


def test_every_preset_is_taken_as_it_is_and_every_number_has_a_checked_range_and_can_be_given_as_it_stands() -> None:
    for method, entry in METHODS.items():
        for name, options in entry.presets.items():
            assert method_options(method, name) == options, (method, name)
    assert method_options("phyradgs", "paper").motion == MicroViews(8, 5)

    for method, path, current in NUMBERS:
        for name, absurd in ABSURD.items():
            value = [absurd] * len(current) if isinstance(current, tuple) else absurd
            with pytest.raises(InputError) as refused:
                method_options(method, None, nested(path, value))
                pytest.fail(f"{method} {'.'.join(path)}, {name}: taken")
            assert path[-1] in str(refused.value) and len(str(refused.value)) < 700, (method, path, name)
    assert len(NUMBERS) > 100
    for method, path, current in NUMBERS:
        value = list(current) if isinstance(current, tuple) else float(current)
        assert method_options(method, None, nested(path, value)) == method_options(method), (method, path)
    motion = method_options("phyradgs", None, {"strips": 2.0, "sub_intervals": 3.0}).motion
    assert (motion.strips, motion.sub_intervals) == (2, 3) and isinstance(motion.strips, int)


@dataclass(frozen=True)
class Halves:
    """Two poses per line, of which the first half of the panel has its own."""

    early: float = 0.25
    offsets: tuple[float, ...] = (0.0,)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        shutter, half = scan.shutter, scan.lines // 2
        share = np.array([self.early, 0.75, self.early, 1.0])
        first = np.array([0, 0, half, half], np.int32)
        last = np.array([half, half, scan.lines, scan.lines], np.int32)
        time_s = scan.frame_start_s[frame] + share * shutter.span_s
        pose = scan.trajectory.pose(frame, time_s)
        return TimeCells(pose, time_s, first, last, np.full(4, 0.5), scan.lines, shutter.axis)


@pytest.mark.parametrize("method", ["fdk", "sirt", "fista", "phyradgs"])
def test_a_motion_of_ones_own_works_and_is_named(method, rt) -> None:
    scan = simulate("foot", size=16, detector=20, views=6, device=rt)
    few = {} if method == "fdk" else {"iterations": 2}
    own, static = (reconstruct(scan, plan_run(method, {**few, "motion": motion}), rt) for motion in (Halves(), Static()))
    assert np.isfinite(own.volume).all() and np.any(own.volume != static.volume)
    assert own.facts["options"]["motion"] == {"name": "Halves", "early": 0.25, "offsets": "(0.0,)"}
    assert static.facts["options"]["motion"] == {"name": "static"}


def test_motions_that_are_none_of_the_methods_are_refused() -> None:
    """Names are those that the command line takes."""
    assert_refused({
        "--motion": lambda: method_options("sirt", None, {"motion": Halves(), "strips": 3}),
        r"cells\(scan, frame\)": lambda: SirtOptions(motion="per-row"),
        r"one of Static\(\), .* or a class of your own": lambda: SirtOptions(motion=Exact()),
        "one of static, per-row for": lambda: method_options("fdk", None, {"motion": "exact"}),
    })  # fmt: skip


def test_a_method_takes_its_own_motions_with_the_counts_that_they_have() -> None:
    assert MOTIONS["phyradgs"] == MOTIONS["r2"] == ("static", "static-start", "micro-views", "centres", "exact")
    assert "exact" not in MOTIONS["sirt"] + MOTIONS["fdk"] and "micro-views" not in MOTIONS["fdk"]
    strips = {"micro-views", "centres"}
    models = {"strips": strips, "sub_intervals": {*strips, "per-row", "own-times"}, "segments": {"exact"}}
    pairs = [(method, name) for method, names in MOTIONS.items() for name in names]
    for (method, name), (key, having) in product(pairs, models.items()):
        changes = {"motion": name, key: 3}
        if name in having and method not in ("fdk", "fbp"):  # one pose per line
            assert getattr(method_options(method, None, changes).motion, key) == 3, (method, changes)
            continue
        with pytest.raises(InputError, match=f"--{key.replace('_', '-')}: ") as refused:
            method_options(method, None, changes)
        assert not any(other in refused.value.expected for other in having - set(MOTIONS[method])), (method, changes)


def test_strips_mean_micro_views_where_the_motion_is_exact() -> None:
    for given, expected in [
        ({}, "exact"), ({"strips": 4}, "micro-views"), ({"sub_intervals": 3}, "micro-views"),
        ({"strips": 4, "sub_intervals": 3}, "micro-views"), ({"segments": 3}, "exact"),
        ({"motion": "centres", "strips": 4}, "centres"), ({"time_error": 0.01}, "exact"), ({"motion": "static"}, "static"),
    ]:  # fmt: skip
        motion = method_options("phyradgs", None, given).motion
        assert motion.name == expected
        assert all(getattr(motion, key) == value for key, value in given.items() if key != "motion")
    with pytest.raises(InputError, match="--strips|--segments"):  # counts of two models
        method_options("phyradgs", None, {"strips": 4, "segments": 3})
    assert method_options("sirt", None, {"strips": 4}).motion.name == "micro-views"


@pytest.mark.parametrize("method", ["naf", "sax-nerf"])
def test_a_run_says_in_one_line_what_to_install(rt, method, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(neural, "has_torch", lambda: False)
    scan = simulate("jaw", size=8, detector=12, views=3, device=rt)
    with pytest.raises(InputError, match=f"--method {method}: found no PyTorch"):
        reconstruct(scan, plan_run(method), rt)
    save_scan(tmp_path / "scan.h5", scan)
    command = ["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out.h5"), "--method", method]
    assert load_cli().run(command) == 2 and not (tmp_path / "out.h5").exists()
    (said,) = (line for line in capsys.readouterr().err.splitlines() if "PyTorch" in line)
    assert 'pip install "phyradgs-cl[neural]"' in said
