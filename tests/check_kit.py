"""What tests of whole checks share: answers by question, and scans that state another geometry or sense of rotation."""

from dataclasses import replace
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, Scan
from phyradgs_cl.check import CheckResult


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
