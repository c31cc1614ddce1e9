"""Methods: one file each, one signature for all, ``(scan, options, rt, seed, report) → Reconstruction``."""

from phyradgs_cl.reconstructors.prepared import InputOptions
from phyradgs_cl.reconstructors.registry import (
    METHODS,
    Method,
    input_options,
    method_name,
    method_options,
    reconstruct,
)
from phyradgs_cl.reconstructors.result import Progress, ProgressReport, Reconstruction, State, ignore_progress

__all__ = [
    "METHODS",
    "InputOptions",
    "Method",
    "Progress",
    "ProgressReport",
    "Reconstruction",
    "State",
    "ignore_progress",
    "input_options",
    "method_name",
    "method_options",
    "reconstruct",
]
