"""Runs of a sweep: they go on from their own checkpoint, and from no other."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.io import checkpoint_path
from phyradgs_cl.reconstructors import Progress, plan_run
from phyradgs_cl.workflow.reconstruct import resume_or_restart

pytestmark = pytest.mark.slow
PLAN = plan_run("sirt", {"iterations": 6})


@pytest.fixture
def checkpoint(tmp_path) -> Path:
    return checkpoint_path(tmp_path / "volume.h5")


@pytest.fixture
def run(rt, tiny_scan, tmp_path):
    """A run that may be stopped at an iteration → its result, and the iterations that it reported."""

    def go(stop_at=None, plan=PLAN, scan=tiny_scan, name="volume.h5"):
        seen = []

        def report(progress: Progress) -> None:
            seen.append(progress.iteration)
            if progress.iteration == stop_at:
                raise KeyboardInterrupt

        return resume_or_restart(plan, scan, tmp_path / name, lambda: rt, report)[0], seen

    return go


def test_a_stopped_run_goes_on_to_the_same_bits(run, checkpoint) -> None:
    assert run(stop_at=3)[0].interrupted_at
    result, seen = run()
    assert not result.interrupted_at and min(seen) > 3 and not checkpoint.exists()
    np.testing.assert_array_equal(result.volume, run(name="alone.h5")[0].volume)


@pytest.mark.parametrize("what", ["damaged", "of another seed"])
def test_a_checkpoint_that_does_not_fit_is_set_aside(run, checkpoint, what) -> None:
    run(stop_at=3)
    content = checkpoint.read_bytes()
    if what == "damaged":
        content = content[: len(content) // 2]
        checkpoint.write_bytes(content)
    result, seen = run(plan=PLAN if what == "damaged" else replace(PLAN, seed=1))
    assert not result.interrupted_at and min(seen) <= 3
    assert Path(f"{checkpoint}.bak").read_bytes() == content


def test_a_checkpoint_outlives_a_missing_scan_and_no_other_method_takes_it(run, checkpoint) -> None:
    run(stop_at=3)
    with pytest.raises(InputError, match="none.h5"):
        run(scan=checkpoint.with_name("none.h5"))
    assert checkpoint.exists() and not run(plan=plan_run("fdk"))[0].interrupted_at
