"""Methods: one file each, one signature for all, ``(scan, options, rt, seed, report) → Reconstruction``."""

from phyradgs_cl.reconstructors.registry import METHODS, Method, method_options, reconstruct
from phyradgs_cl.reconstructors.result import Progress, ProgressReport, Reconstruction, State, ignore_progress

__all__ = [
    "METHODS",
    "Method",
    "Progress",
    "ProgressReport",
    "Reconstruction",
    "State",
    "ignore_progress",
    "method_options",
    "reconstruct",
]
