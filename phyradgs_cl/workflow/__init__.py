"""From file to file: what the commands do, without a word to the user."""

from phyradgs_cl.workflow.evaluate import run_evaluation
from phyradgs_cl.workflow.files import load_reference, load_scan, summary
from phyradgs_cl.workflow.reconstruct import ReconstructionJob, profile_report, run_reconstruction
from phyradgs_cl.workflow.simulate import (
    SimulationJob,
    refuse_jitter,
    refuse_noise_options,
    run_simulation,
)

__all__ = [
    "ReconstructionJob",
    "SimulationJob",
    "load_reference",
    "load_scan",
    "profile_report",
    "refuse_jitter",
    "refuse_noise_options",
    "run_evaluation",
    "run_reconstruction",
    "run_simulation",
    "summary",
]
