"""Numbers that no scanner has, most of them in a wrong unit: each is refused or warned of in one line."""

import logging
from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl.acquisition.data_sheet import Named
from phyradgs_cl.acquisition.field_of_view import field_of_view_mm
from phyradgs_cl.acquisition.geometry import ConeGeometry
from phyradgs_cl.acquisition.summary import cone_deg, frame_time_s, source_angle_rad
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

if TYPE_CHECKING:
    from phyradgs_cl.acquisition.scan import Scan

log = logging.getLogger(__name__)
_WIDEST_DEG = 120.0  # of a panel seen from the source; dental scanners reach 30, nano-CT 60
_WRONG_UNIT = 100.0  # frames that one readout takes: ms for s makes it some hundreds
_SLACK = 1e-3  # relative: times and angles come rounded
MANY_FRAMES = 10  # of which fewer may well lie within a few degrees
_OPAQUE, _FEW = 50.0, 0.01  # no panel sees through more; the share of pixels that may be broken


def check_plausible(scan: "Scan", named: Named = str) -> None:
    """InputError for pixels, voxels and times that no scanner has; warnings for angles that look like radians and line
    integrals that look like counts. ``named``: how messages call ``pixel_size_mm``, ``grid``, ``readout_s``, ``exposure_s``,
    ``angles`` and ``quantity``."""
    _check_panel(scan.geometry, named("pixel_size_mm"))
    _check_voxels(scan.grid, scan.geometry, named("grid"))
    if scan.is_fly and scan.frames > 1:
        for name in ("readout_s", "exposure_s"):
            _check_time(named(name), getattr(scan.shutter, name), frame_time_s(scan))
    warn_of_radians(np.rad2deg(np.unwrap(source_angle_rad(scan)[:, 0])), named("angles"))
    opaque = (scan.projections > _OPAQUE) & scan.valid
    if np.count_nonzero(opaque) > _FEW * opaque.size:
        text = "line integrals of up to %.3g: no panel sees through more than %g; are they counts? say %s"
        log.warning(text, scan.projections[opaque].max(), _OPAQUE, named("quantity"))


def warn_of_radians(angle_deg: np.ndarray, subject: str) -> None:
    """Warns of angles (F,) of many frames that lie within 2π degrees."""
    span_deg = float(np.ptp(angle_deg))
    if len(angle_deg) >= MANY_FRAMES and 0 < span_deg <= 2 * np.pi * (1 + _SLACK):
        log.warning("%s: %d frames within %.4g°: are they radians?", subject, len(angle_deg), span_deg)


def _check_panel(geometry: ConeGeometry, subject: str) -> None:
    widest_deg = max(cone_deg(geometry))
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


def _check_time(subject: str, time_s: float, frame_s: float) -> None:
    frames = time_s / frame_s
    if frames > _WRONG_UNIT:
        expected = f"at most the {frame_s:.3g} s from frame to frame"
        raise InputError(subject, f"{time_s:.4g} s", expected, "give the time in the unit of its name: is it ms?")
    if frames > 1 + _SLACK:
        text = "%s: %.4g s, longer than the %.4g s from frame to frame: a line would open again while it is open or read"
        log.warning(text, subject, time_s, frame_s)
