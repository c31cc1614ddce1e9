"""Simulation: a phantom or volume and an acquisition to frames, noise and what panels do to them included."""

from phyradgs_cl.simulation.options import OPTION_NAMES, SimulationOptions, scanner_for, scanner_options
from phyradgs_cl.simulation.run import default_time_samples, simulate, simulated_scan
from phyradgs_cl.simulation.scenes import Scene, phantom_scene, volume_scene
from phyradgs_cl.simulation.sources import AnalyticSource, FrameSource, VolumeSource, line_groups

__all__ = [
    "OPTION_NAMES", "AnalyticSource", "FrameSource", "Scene", "SimulationOptions", "VolumeSource", "default_time_samples",
    "line_groups", "phantom_scene", "scanner_for", "scanner_options", "simulate", "simulated_scan", "volume_scene",
]
