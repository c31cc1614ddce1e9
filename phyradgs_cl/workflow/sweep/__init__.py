"""Scans × settings × seeds to one resumable results file, volumes and tables."""

from phyradgs_cl.workflow.sweep.grid import SweepGrid, read_grid
from phyradgs_cl.workflow.sweep.run import RESULTS, SweepJob, SweepProgress, plan_sweep, run_sweep

__all__ = ["RESULTS", "SweepGrid", "SweepJob", "SweepProgress", "plan_sweep", "read_grid", "run_sweep"]
