"""Simulation: scans of phantoms and volumes, with noise and the effects of tube and panel."""

from phyradgs_cl.simulation.options import OPTION_NAMES, SimulationOptions, scanner_for, scanner_options
from phyradgs_cl.simulation.run import default_time_samples, simulate, simulated_scan
from phyradgs_cl.simulation.scenes import (
    AnalyticSource,
    FrameSource,
    Scene,
    VolumeSource,
    line_groups,
    phantom_scene,
    volume_scene,
)

__all__ = [
    "OPTION_NAMES", "AnalyticSource", "FrameSource", "Scene", "SimulationOptions", "VolumeSource", "default_time_samples",
    "line_groups", "phantom_scene", "scanner_for", "scanner_options", "simulate", "simulated_scan", "volume_scene",
]
