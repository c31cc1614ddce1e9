"""What is done to frames before a method sees them, and states of checkpoints, taken only as a run has written them."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from tolerances import FLOAT32

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import simulate
from phyradgs_cl.detector.effects import lagged
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors import Preprocessing, Progress, plan_run, reconstruct
from phyradgs_cl.reconstructors.checkpoint import RUN, with_identity
from phyradgs_cl.reconstructors.preprocess import prepared
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.workflow import load_scan

pytestmark = pytest.mark.slow


def stop(progress: Progress) -> None:
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    return simulate("jaw", size=12, detector=16, views=6, exposure_deg=10.0, peak=3.0, device=rt)


def test_lag_is_undone_unless_it_is_to_be_ignored(rt, scan) -> None:
    slow = replace(scan, projections=lagged(scan.projections, 0.2).astype(np.float32), lag=0.2)
    assert prepared(slow, Preprocessing(ignore_lag=True)) is slow and prepared(scan, Preprocessing()) is scan
    undone = prepared(slow, Preprocessing()).projections
    np.testing.assert_allclose(undone, scan.projections, atol=FLOAT32 * np.exp(3.0))
    cases = (scan, Preprocessing()), (slow, Preprocessing()), (slow, Preprocessing(ignore_lag=True))
    volumes = [reconstruct(s, replace(plan_run("fdk"), preprocessing=before), rt).volume for s, before in cases]
    undone, ignored = (np.abs(volume - volumes[0]).max() for volume in volumes[1:])
    assert undone < 1e-3 * np.abs(volumes[0]).max() < ignored


@dataclass(frozen=True)
class Newer(Preprocessing):
    """The options of a later version, with one more."""

    younger: float = 0.0


def test_a_checkpoint_from_before_an_option_is_taken_where_the_option_has_its_default(rt, scan) -> None:
    """Of the preprocessing, and of a step: the older checkpoint has neither. Methods are named in any case."""
    plan = plan_run("Sirt", {"iterations": 3, "steps": "rings", "rings": {"window": 5}})
    state = dict(reconstruct(scan, plan, rt, report=stop).state)
    identity = json.loads(str(state.pop(RUN)))
    identity["input"]["rings"] = {}
    del state["checksum"], identity["input"]["ignore_lag"]
    older = with_identity(state, identity)
    with pytest.raises(InputError, match=r"other input.rings.window \(10, now 5\)"):
        reconstruct(scan, plan, rt, resume=older)
    usual = replace(plan, preprocessing=Newer(steps="rings"))
    assert reconstruct(scan, usual, rt, resume=older).volume.any()
    with pytest.raises(InputError, match="other input.younger"):
        reconstruct(scan, replace(plan, preprocessing=Newer(steps="rings", younger=1.0)), rt, resume=older)


def wrong_arrays(array: np.ndarray) -> dict[str, np.ndarray | None]:
    """An array of a state in every way in which no run writes it."""
    wrong: dict[str, np.ndarray | None] = {
        "removed": None, "text": np.array("text"), "of another shape": np.stack([array] * 2),
        "empty": array.reshape(-1)[:0], "complex": np.zeros(array.shape, complex), "truth": np.zeros(array.shape, bool),
    }  # fmt: skip
    if array.dtype.kind == "f" and array.size:
        for number in (np.nan, np.inf, -np.inf):
            wrong[str(number)] = array.copy()
            wrong[str(number)].reshape(-1)[0] = number
    return wrong


@pytest.mark.parametrize("method", ["sirt", "cgls", "fista-tv", "os-sart", "phyradgs"])
def test_every_array_of_a_methods_state_is_checked(rt: Runtime, tiny_scan: Path, method: str) -> None:
    """Resumed with one array that is wrong, no method begins."""
    changes = {"gaussians": 30, "iterations": 100, "motion": "static"} if method == "phyradgs" else {"iterations": 6}
    scan, plan = load_scan(tiny_scan), plan_run(method, changes | ({"noise_stop": 0} if method == "cgls" else {}))
    good = reconstruct(scan, plan, rt, report=stop).state
    assert good is not None and reconstruct(scan, plan, rt, resume=good, report=stop).volume.any()
    wrong = [(name, how, array) for name, values in good.items() for how, array in wrong_arrays(values).items()]
    wrong += [("iteration", str(value), np.array(value)) for value in (-1, 10**6, 2**62)]
    wrong += [("queue", str(value), np.array([value, 0])) for value in (-1, 4, 2**40) if "queue" in good]
    for name, how, array in wrong:
        if (name, how) == ("queue", "empty"):
            continue  # a new pass begins
        state = {other: values for other, values in (good | {name: array}).items() if values is not None}
        with pytest.raises(InputError, match="checkpoint"):
            reconstruct(scan, plan, rt, resume=state)
            pytest.fail(f"taken: {name}, {how}")


def test_a_state_of_another_version_is_refused(rt: Runtime, tiny_scan: Path) -> None:
    scan, plan = load_scan(tiny_scan), plan_run("fista", {"iterations": 6})
    good = reconstruct(scan, plan, rt, report=stop).state
    assert good is not None
    older = {name: array for name, array in good.items() if name not in ("ahead", RUN, "checksum")}
    with pytest.raises(InputError, match="found a run of another version, without ahead"):
        reconstruct(scan, plan, rt, resume=with_identity(older, json.loads(str(good[RUN]))))
