"""A reconstruction that goes on from its checkpoint where there is one of the same run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from phyradgs_cl.errors import InputError
from phyradgs_cl.io import checkpoint_path
from phyradgs_cl.reconstructors import ProgressReport, Reconstruction, method_of
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.workflow.reconstruct import ReconstructionJob, run_reconstruction


def go_on(
    job: ReconstructionJob, make_runtime: Callable[[], Runtime], report: ProgressReport
) -> tuple[Reconstruction, dict[str, float]]:
    """As ``run_reconstruction``; a checkpoint of another scan or other options, or a damaged one, is set aside."""
    checkpoint = checkpoint_path(job.output)
    if checkpoint.is_file() and method_of(job.method).is_resumable:
        try:
            return run_reconstruction(replace(job, resume=True), make_runtime, report)
        except InputError as error:
            named = ("--resume", str(checkpoint))
            if error.culprit not in named and not error.culprit.startswith("checkpoint"):
                raise
    return run_reconstruction(replace(job, resume=False), make_runtime, report)


def is_whole(result: Reconstruction) -> bool:
    """Whether the run came to its end; a stopped one has left a checkpoint."""
    return result.facts.get("interrupted_at") is None
