"""A scan's numbers in two lines, and a refusal or warning of those that no scanner has, most of them in a wrong unit."""

import logging
import math
from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl.acquisition.field_of_view import field_of_view_mm
from phyradgs_cl.acquisition.geometry import ConeGeometry
from phyradgs_cl.acquisition.readout import Named
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

if TYPE_CHECKING:
    from phyradgs_cl.acquisition.scan import Scan

log = logging.getLogger(__name__)
_WIDEST_DEG = 120.0  # of a panel seen from the source; dental scanners reach 30, nano-CT 60
_WRONG_UNIT = 100.0  # frames that one readout takes: ms for s makes it some hundreds
_TIMES = 17  # of an exposure: between two of them no gantry turns by half a turn
_SLACK = 1e-3  # relative: times and angles come rounded
_MANY_FRAMES = 10  # fewer may lie within a few degrees on purpose
_OPAQUE, _FEW = 50.0, 0.01  # no panel sees through more; the share of pixels that may be broken


def summary(scan: "Scan") -> str:
    """Returns both lines. Values that the scan's provenance lists as assumed are marked as such."""
    return f"{_timing(scan)}\n{_sizes(scan)}"


def _cone_deg(geometry: ConeGeometry) -> tuple[float, float]:
    """Full angles (cone along v, fan along u) in degrees under which the source sees the panel."""
    sides = zip(geometry.detector_shape, geometry.pixel_size_mm, geometry.detector_offset_mm, strict=True)
    ends_mm = [[offset - count * pitch / 2, offset + count * pitch / 2] for count, pitch, offset in sides]
    low, high = np.rad2deg(np.arctan2(ends_mm, geometry.source_to_detector_mm)).T
    cone, fan = (high - low).tolist()
    return cone, fan


def _frame_time_s(scan: "Scan") -> float:
    """Median time from frame to frame; NaN of a single frame."""
    return float(np.median(np.diff(scan.frame_start_s))) if scan.frames > 1 else math.nan


def _source_angle_rad(scan: "Scan") -> np.ndarray:
    """(F, T): angle of the source about the axis at T times of each frame's exposure, without jumps of a turn in a row."""
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
        order = marked(f"{shutter.first} first", "axis", "first")
        parts.append(f"{shutter.axis} read in {1000 * shutter.readout_s:.4g} ms, {order}")
    else:
        parts.append(marked("all lines at once", "readout"))
    if "exposure" not in assumed and scan.frames > 1:
        parts.append(f"{1 / _frame_time_s(scan):.4g} fps")
    angle_rad = _source_angle_rad(scan)
    arc_deg = abs(float(np.rad2deg(np.median(angle_rad[:, -1] - angle_rad[:, 0]))))
    parts.append(f"exposure {arc_deg:.4g}° in " + marked(f"{1000 * shutter.exposure_s:.4g} ms", "exposure"))
    if "angles" in assumed:
        parts.append(marked("angles as each frame opens", "angles"))
    averaged = "line integrals" if scan.detector_model == "log" else "intensity"
    return "timing: " + "; ".join([*parts, marked(f"averages {averaged}", "average")])


def _sizes(scan: "Scan") -> str:
    cone, fan = _cone_deg(scan.geometry)
    seen_mm = tuple(2 * half for half in field_of_view_mm(scan.geometry))
    voxel_mm = scan.grid.voxel_size_mm
    return (
        f"sizes: field of view {_joined(seen_mm)} mm (z, y, x), fan {fan:.3g}°, cone {cone:.3g}°, voxels "
        f"{_joined(voxel_mm[:1] if len(set(voxel_mm)) == 1 else voxel_mm)} mm, largest line integral {_largest(scan):.3g}"
    )


def _largest(scan: "Scan") -> float:
    return float(np.max(scan.projections, where=scan.valid, initial=-np.inf))


def _joined(values: tuple[float, ...]) -> str:
    return " × ".join(f"{value:.4g}" for value in values)


def check_plausible(scan: "Scan", named: Named = str) -> None:
    """InputError for pixels, voxels and times that no scanner has; warnings for angles that look like radians and line
    integrals that look like counts. ``named``: how messages call ``pixel_size_mm``, ``grid``, ``readout_s``, ``exposure_s``,
    ``angles`` and ``quantity``."""
    _check_panel(scan.geometry, named("pixel_size_mm"))
    _check_voxels(scan.grid, scan.geometry, named("grid"))
    looks_like_radians = _warn_of_radians(np.rad2deg(np.unwrap(_source_angle_rad(scan)[:, 0])), named("angles"))
    if scan.is_fly and scan.frames > 1 and not looks_like_radians:
        for what in ("readout", "exposure"):
            _check_time(named(f"{what}_s"), what, getattr(scan.shutter, f"{what}_s"), _frame_time_s(scan))
    opaque = sum(np.count_nonzero(frame[valid] > _OPAQUE) for frame, valid in zip(scan.projections, scan.valid, strict=True))
    if opaque > _FEW * scan.projections.size:
        text = "line integrals of up to %.3g: no panel sees through more than %g; are they counts? say %s"
        log.warning(text, _largest(scan), _OPAQUE, named("quantity"))


def _warn_of_radians(angle_deg: np.ndarray, subject: str) -> bool:
    """Whether angles (F,) of many frames lie within 2π degrees, which is warned of."""
    span_deg = float(np.ptp(angle_deg))
    looks_so = len(angle_deg) >= _MANY_FRAMES and 0 < span_deg <= 2 * np.pi * (1 + _SLACK)
    if looks_so:
        text = "%s: %d frames within %.4g°: are they radians? Give degrees"
        log.warning(text, subject, len(angle_deg), span_deg)
    return looks_so


def _check_panel(geometry: ConeGeometry, subject: str) -> None:
    widest_deg = max(_cone_deg(geometry))
    if widest_deg > _WIDEST_DEG:
        pitch_mm = " × ".join(f"{pitch:g}" for pitch in geometry.pixel_size_mm)
        found = f"pixels of {pitch_mm} mm, a panel seen under {widest_deg:.0f}°"
        remedy = "give the pitch of one pixel in mm: not in µm, and not the panel's width"
        raise InputError(subject, found, f"less than {_WIDEST_DEG:.0f}°", remedy)


def _check_voxels(grid: Grid, geometry: ConeGeometry, subject: str) -> None:
    half_mm = field_of_view_mm(geometry)[1]
    columns = geometry.detector_shape[1]
    if columns > 2 and min(grid.voxel_size_mm) > half_mm:
        shape = "×".join(map(str, grid.shape))
        found = f"{shape} voxels of {min(grid.voxel_size_mm):.4g} mm"
        expected = f"voxels of about {2 * half_mm / columns:.3g} mm, in a field of view of {2 * half_mm:.4g} mm"
        raise InputError(subject, found, expected, "correct the number of voxels, or the unit of a length")


def _check_time(subject: str, what: str, time_s: float, frame_s: float) -> None:
    frames = time_s / frame_s
    found = f"{what} of {time_s:.4g} s, {frames:.3g} times the {frame_s:.3g} s from frame to frame"
    if frames > _WRONG_UNIT:
        raise InputError(subject, found, "at most one frame's time", "correct its unit, or the frame time's")
    if frames > 1 + _SLACK:
        log.warning("%s: %s: a line would open again while it is open or read; is its unit right?", subject, found)
