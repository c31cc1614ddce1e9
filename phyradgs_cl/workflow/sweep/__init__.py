"""Scans × settings × seeds to one resumable results file, volumes and tables."""

from phyradgs_cl.workflow.sweep.grid import Setting, SweepGrid, read_grid
from phyradgs_cl.workflow.sweep.plan import SweepRun, plan_sweep
from phyradgs_cl.workflow.sweep.run import RESULTS, SweepJob, SweepProgress, run_sweep

__all__ = [
    "RESULTS", "Setting", "SweepGrid", "SweepJob", "SweepProgress", "SweepRun", "plan_sweep",
    "read_grid", "run_sweep"
]  # fmt: skip
