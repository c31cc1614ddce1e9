"""Runs of a sweep: they go on from their own checkpoint, and from no other."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.io import checkpoint_path
from phyradgs_cl.reconstructors import Progress, Reconstruction, RunPlan, plan_run
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.workflow.reconstruct import resume_or_restart

pytestmark = pytest.mark.slow


class Report:
    """Notes the iterations that were reported, and presses Ctrl-C at one of them."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.stop_at = stop_at
        self.seen: list[int] = []

    def __call__(self, progress: Progress) -> None:
        self.seen.append(progress.iteration)
        if progress.iteration == self.stop_at:
            raise KeyboardInterrupt


@dataclass(frozen=True)
class Job:
    plan: RunPlan
    scan: Path
    output: Path

    def run(self, rt: Runtime, report: Report) -> Reconstruction:
        return resume_or_restart(self.plan, self.scan, self.output, lambda: rt, report)[0]


@pytest.fixture
def job(tiny_scan: Path, tmp_path: Path) -> Job:
    return Job(plan_run("sirt", {"iterations": 6}), tiny_scan, tmp_path / "volume.h5")


def stopped(job: Job, rt: Runtime) -> bytes:
    """The checkpoint of a run that was stopped in the middle."""
    assert job.run(rt, Report(stop_at=3)).interrupted_at
    return checkpoint_path(job.output).read_bytes()


def test_a_stopped_run_goes_on_to_the_same_bits(job, rt, tmp_path) -> None:
    stopped(job, rt)
    rest = Report()
    result = job.run(rt, rest)
    assert not result.interrupted_at and min(rest.seen) > 3
    alone = replace(job, output=tmp_path / "alone.h5").run(rt, Report())
    np.testing.assert_array_equal(result.volume, alone.volume)
    assert not checkpoint_path(job.output).exists()


@pytest.mark.parametrize("what", ["damaged", "of another seed"])
def test_a_checkpoint_that_does_not_fit_is_set_aside(job, rt, what) -> None:
    content = stopped(job, rt)
    if what == "of another seed":
        job = replace(job, plan=replace(job.plan, seed=1))
    else:
        content = content[: len(content) // 2]
        checkpoint_path(job.output).write_bytes(content)
    whole = Report()
    result = job.run(rt, whole)
    assert not result.interrupted_at and min(whole.seen) <= 3
    aside = Path(f"{checkpoint_path(job.output)}.bak")
    assert aside.read_bytes() == content


def test_a_checkpoint_outlives_a_missing_scan_and_no_other_method_takes_it(job, rt) -> None:
    stopped(job, rt)
    with pytest.raises(InputError, match="none.h5"):
        replace(job, scan=job.scan.with_name("none.h5")).run(rt, Report())
    assert checkpoint_path(job.output).exists()
    assert not replace(job, plan=plan_run("fdk")).run(rt, Report()).interrupted_at
