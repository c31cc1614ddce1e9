"""Simulates scans of phantoms and volumes, with noise and the effects of tube and panel."""

from phyradgs_cl.simulation.object_motion import ObjectMotion, load_object_motion
from phyradgs_cl.simulation.options import OPTION_NAMES, SimulationOptions, scanner_for, scanner_options
from phyradgs_cl.simulation.run import default_time_samples, simulate, simulated_scan
from phyradgs_cl.simulation.scenes import Scene, phantom_scene, volume_scene
from phyradgs_cl.simulation.sources import (
    AnalyticSource,
    DeformedSource,
    FrameSource,
    VolumeSource,
    line_groups,
)

__all__ = [
    "OPTION_NAMES", "AnalyticSource", "DeformedSource", "FrameSource", "ObjectMotion", "Scene", "SimulationOptions",
    "VolumeSource", "default_time_samples", "line_groups", "load_object_motion", "phantom_scene", "scanner_for",
    "scanner_options", "simulate", "simulated_scan", "volume_scene",
]
