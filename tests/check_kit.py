"""What tests of whole checks share: answers by question, and scans that state another geometry or sense of rotation."""

from dataclasses import replace
from typing import Any

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
