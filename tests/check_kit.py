"""What tests of whole checks share: answers by question, and scans that state another geometry or sense of rotation."""

from dataclasses import replace
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, Scan, pixel_centres
from phyradgs_cl.api import static_scan
from phyradgs_cl.check import CheckResult
from phyradgs_cl.phantoms import EllipsoidPhantom


def verdicts(found: CheckResult) -> dict[str, str]:
    return {finding.question: finding.verdict for finding in found.findings}


def suspected(found: CheckResult) -> list[str]:
    return [finding.question for finding in found.suspicious]


def stated(scan: Scan, **geometry: Any) -> Scan:
    """The same frames with another geometry stated."""
    changed = replace(scan.geometry, **geometry)
    return replace(scan, geometry=changed, trajectory=CircularOrbit(changed, scan.trajectory.kinematics))


def negative(scan: Scan) -> Scan:
    """The same frames with angles of the other sign stated."""
    sweeps = scan.trajectory.kinematics
    turned = replace(sweeps, angle_start_rad=-sweeps.angle_start_rad, angle_end_rad=-sweeps.angle_end_rad)
    return replace(scan, trajectory=CircularOrbit(scan.geometry, turned))


def some_frames(scan: Scan, chosen: slice | np.ndarray) -> Scan:
    """The scan with some of its frames."""
    sweeps = scan.trajectory.kinematics
    kept = {name: getattr(sweeps, name)[chosen] for name in ("start_s", "angle_start_rad", "angle_end_rad")}
    return replace(
        scan, projections=scan.projections[chosen], frame_start_s=scan.frame_start_s[chosen],
        trajectory=CircularOrbit(scan.geometry, replace(sweeps, **kept)),
    )  # fmt: skip


def cropped(scan: Scan, part: Any, **geometry: Any) -> Scan:
    """A smaller panel, the part of every frame that an index of all frames takes."""
    frames = scan.projections[part]
    panel = replace(scan.geometry, detector_shape=frames.shape[1:], **geometry)
    orbit = CircularOrbit(panel, scan.trajectory.kinematics)
    return replace(scan, projections=frames, geometry=panel, trajectory=orbit)


def cone_scan(phantom: EllipsoidPhantom, angles_deg: np.ndarray, noise: float) -> Scan:
    """A stop-and-shoot scan of closed-form line integrals and white noise, whose deviation is ``noise``."""
    geometry = ConeGeometry(5.0, 7.0, (32, 32), 0.125)
    pixels = pixel_centres(poses := geometry.pose(np.deg2rad(angles_deg)), geometry.detector_shape)
    frames = phantom.line_integrals(np.broadcast_to(poses[:, None, None, :3], pixels.shape), pixels)
    frames = frames + np.random.default_rng(7).normal(0, noise, frames.shape)
    return static_scan(frames.astype(np.float32), geometry, angles_deg)
