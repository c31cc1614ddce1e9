"""Simulates scans of phantoms and volumes, with noise and the effects of tube and panel."""

from phyradgs_cl.simulation.object_motion import ObjectMotion, load_object_motion
from phyradgs_cl.simulation.run import (
    OPTION_NAMES,
    SimulationOptions,
    default_time_samples,
    scanner_for,
    scanner_options,
    simulate,
    simulated_scan,
)
from phyradgs_cl.simulation.scenes import Scene, phantom_scene, volume_scene
from phyradgs_cl.simulation.sources import AnalyticSource, DeformedSource, FrameSource, VolumeSource

__all__ = [
    "OPTION_NAMES", "AnalyticSource", "DeformedSource", "FrameSource", "ObjectMotion", "Scene", "SimulationOptions",
    "VolumeSource", "default_time_samples", "load_object_motion", "phantom_scene", "scanner_for", "scanner_options",
    "simulate", "simulated_scan", "volume_scene",
]
