"""A scan in two lines: when its lines were open, and what its geometry and pixels amount to."""

import math
from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl.acquisition.field_of_view import field_of_view_mm
from phyradgs_cl.acquisition.geometry import ConeGeometry

if TYPE_CHECKING:
    from phyradgs_cl.acquisition.scan import Scan

_TIMES = 17  # of an exposure: between two of them no gantry turns by half a turn

def summary(scan: "Scan") -> str:
    """Both lines. What an import assumed, by the scan's provenance, is marked as such."""
    return f"{_timing(scan)}\n{_sizes(scan)}"


def cone_deg(geometry: ConeGeometry) -> tuple[float, float]:
    """Full angles (cone along v, fan along u) in degrees under which the source sees the panel."""
    sides = zip(geometry.detector_shape, geometry.pixel_size_mm, geometry.detector_offset_mm, strict=True)
    ends_mm = [[offset - count * pitch / 2, offset + count * pitch / 2] for count, pitch, offset in sides]
    low, high = np.rad2deg(np.arctan2(ends_mm, geometry.source_to_detector_mm)).T
    cone, fan = (high - low).tolist()
    return cone, fan


def frame_time_s(scan: "Scan") -> float:
    """Median time from frame to frame; NaN of a single frame."""
    return float(np.median(np.diff(scan.frame_start_s))) if scan.frames > 1 else math.nan


def source_angle_rad(scan: "Scan") -> np.ndarray:
    """(F, T): where the source stands about the axis at T times of each frame's exposure; in a row without jumps of a turn."""
    delay_s = np.linspace(0.0, scan.shutter.exposure_s, _TIMES)
    source = np.stack([scan.trajectory.pose(f, t + delay_s)[:, :2] for f, t in enumerate(scan.frame_start_s)])
    angle_rad: np.ndarray = np.unwrap(np.arctan2(source[..., 1], source[..., 0]))
    return angle_rad


def _timing(scan: "Scan") -> str:
    if not scan.is_fly:
        return "timing: every frame at rest"
    assumed = scan.provenance.get("assumed")
    assumed = assumed if isinstance(assumed, list) else []

    def marked(text: str, *names: str) -> str:
        return f"{text} (assumed)" if any(name in assumed for name in names) else text

    shutter, parts = scan.shutter, []
    if shutter.readout_s > 0:
        parts.append(f"{shutter.axis} read in {1000 * shutter.readout_s:.4g} ms, " + marked(f"{shutter.first} first", "axis", "first"))
    else:
        parts.append(marked("all lines at once", "readout"))
    if "exposure" not in assumed and scan.frames > 1:
        parts.append(f"{1 / frame_time_s(scan):.4g} fps")
    angle_rad = source_angle_rad(scan)
    arc_deg = abs(float(np.rad2deg(np.median(angle_rad[:, -1] - angle_rad[:, 0]))))
    parts.append(f"exposure {arc_deg:.4g}° in " + marked(f"{1000 * shutter.exposure_s:.4g} ms", "exposure"))
    if "angles" in assumed:
        parts.append(marked("angles as each frame opens", "angles"))
    averaged = "line integrals" if scan.detector_model == "log" else "intensity"
    return "timing: " + "; ".join([*parts, marked(f"averages {averaged}", "average")])


def _sizes(scan: "Scan") -> str:
    cone, fan = cone_deg(scan.geometry)
    seen_mm = tuple(2 * half for half in field_of_view_mm(scan.geometry))
    largest = float(np.max(scan.projections, where=scan.valid, initial=-np.inf))
    voxel_mm = scan.grid.voxel_size_mm
    return (
        f"sizes: field of view {_joined(seen_mm)} mm (z, y, x), fan {fan:.3g}°, cone {cone:.3g}°, "
        f"voxels {_joined(voxel_mm[:1] if len(set(voxel_mm)) == 1 else voxel_mm)} mm, largest line integral {largest:.3g}"
    )


def _joined(values: tuple[float, ...]) -> str:
    return " × ".join(f"{value:.4g}" for value in values)
