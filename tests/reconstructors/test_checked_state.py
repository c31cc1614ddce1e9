"""States of checkpoints are taken only as a run has written them."""

import json
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors import Progress, plan_run, reconstruct
from phyradgs_cl.reconstructors.checkpoint import RUN, with_identity
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.workflow import load_scan

pytestmark = pytest.mark.slow


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


def stop(progress: Progress) -> None:
    raise KeyboardInterrupt


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
