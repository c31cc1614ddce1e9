"""Options by name: converted, checked, and refused with the names that would have been right."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from itertools import product
from typing import Any

import numpy as np
import pytest

from phyradgs_cl.acquisition import Exact, MicroViews, Scan, Static, TimeCells
from phyradgs_cl.api import simulate
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
    for name in reversed(path):
        value = {name: value}
    assert isinstance(value, dict)
    return value


NUMBERS = [
    (method, path, value)
    for method, entry in METHODS.items()
    for path, value in numeric_options(next(iter(entry.presets.values())))
]


def refusal(method: str, changes: dict[str, Any]) -> str:
    """What is said of the changes; nothing where they are taken."""
    try:
        method_options(method, None, changes)
    except InputError as error:
        return str(error)
    return ""


def test_every_preset_is_taken_as_it_is() -> None:
    for method, entry in METHODS.items():
        for name, options in entry.presets.items():
            assert method_options(method, name) == options, (method, name)
    assert method_options("phyradgs", "paper").motion == MicroViews(8, 5)


def test_every_number_has_a_checked_range_and_can_be_given_as_it_stands() -> None:
    for method, path, current in NUMBERS:
        for name, absurd in ABSURD.items():
            said = refusal(method, nested(path, [absurd] * len(current) if isinstance(current, tuple) else absurd))
            assert path[-1] in said and len(said) < 700, f"{method} {'.'.join(path)}, {name}: {said!r}"
    assert len(NUMBERS) > 100
    for method, path, current in NUMBERS:
        value = list(current) if isinstance(current, tuple) else float(current)
        assert method_options(method, None, nested(path, value)) == method_options(method), (method, path)


def test_counts_of_motion_may_be_given_as_floats() -> None:
    options = method_options("phyradgs", None, {"strips": 2.0, "sub_intervals": 3.0, "iterations": 40.0})
    assert (options.motion.strips, options.motion.sub_intervals, options.iterations) == (2, 3, 40)
    assert isinstance(options.motion.strips, int)
    assert not method_options("phyradgs", None, {"control": {"every": 0}}).control.is_due(600, 2000)


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
    own, static = (
        reconstruct(scan, plan_run(method, {**few, "motion": motion}), rt)
        for motion in (Halves(), Static())
    )
    assert np.isfinite(own.volume).all() and np.any(own.volume != static.volume)
    assert own.facts["options"]["motion"] == {"name": "Halves", "early": 0.25, "offsets": "(0.0,)"}
    assert static.facts["options"]["motion"] == {"name": "static"}


def test_a_motion_of_ones_own_has_cells_and_no_counts() -> None:
    with pytest.raises(InputError, match="--motion"):
        method_options("sirt", None, {"motion": Halves(), "strips": 3})
    with pytest.raises(InputError, match=r"cells\(scan, frame\)"):
        SirtOptions(motion="per-row")
    with pytest.raises(InputError, match=r"one of Static\(\), .* or a class of your own"):
        SirtOptions(motion=Exact())


def motions_of(method: str) -> tuple[str, ...]:
    return tuple(_models(next(iter(METHODS[method].presets.values()))))


def test_a_method_takes_its_own_motions() -> None:
    for method in METHODS:
        own = motions_of(method)
        for name in own:
            assert method_options(method, None, {"motion": name}).motion.name == name, (method, name)
    for method in ("phyradgs", "r2"):
        assert motions_of(method) == ("static", "static-start", "micro-views", "centres", "exact")
    for method in ("sirt", "fdk"):
        assert "exact" not in motions_of(method)
    assert "micro-views" not in motions_of("fdk")


def test_counts_belong_to_the_motions_that_have_them() -> None:
    strips = {"micro-views", "centres"}
    models = {"strips": strips, "sub_intervals": {*strips, "per-row", "own-times"}, "segments": {"exact"}}
    pairs = [(method, name) for method in METHODS for name in motions_of(method)]
    for (method, name), (key, having) in product(pairs, models.items()):
        changes = {"motion": name, key: 3}
        if name in having and method not in ("fdk", "fbp"):  # one pose per line
            assert getattr(method_options(method, None, changes).motion, key) == 3, (method, changes)
            continue
        with pytest.raises(InputError, match=f"--{key.replace('_', '-')}: ") as refused:
            method_options(method, None, changes)
        for other in having - set(motions_of(method)):
            assert other not in refused.value.expected, (method, changes)


@pytest.mark.parametrize(("method", "words"), [("fdk", "static, per-row for"), ("sirt", "static, micro-views, per-row for")])
def test_a_refused_motion_names_words_that_the_command_line_takes(method, words) -> None:
    with pytest.raises(InputError, match=f"one of {words}"):
        method_options(method, None, {"motion": "exact"})


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
