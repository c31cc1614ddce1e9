"""Scans from arrays: frames, a geometry and angles are enough."""

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, FrameSweeps, Scan, Shutter
from phyradgs_cl.acquisition.field_of_view import default_grid
from phyradgs_cl.acquisition.scan import check_not_counts, check_others
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.detector.attenuation import QUANTITIES
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.reading.frames import LineIntegrals, line_integrals

log = logging.getLogger(__name__)
_TURN_RAD = 2 * np.pi
_SLACK = 1e-3  # relative: angles come rounded
_MANY = 16  # frames: fewer may well be of a few degrees
_AIR_SLACK = 0.2  # of a transmission, with noise
_CLEAR_STEP_DEG = 90.0  # from frame to frame: below, angles say which way the gantry turns


def fly_scan(
    frames: "ArrayLike",
    geometry: ConeGeometry,
    angles_deg: "ArrayLike",
    *,
    exposure_deg: float,
    readout_ratio: float = 0.0,
    readout: str = "rows",
    readout_direction: int = 1,
    exposure_s: float = 1.0,
    flats: "ArrayLike | None" = None,
    darks: "ArrayLike | None" = None,
    mask: "ArrayLike | None" = None,
    quantity: str | None = None,
    grid: Grid | None = None,
    **others: Any,
) -> Scan:
    """A scan whose gantry never stops, from arrays.

    frames: (F, rows, columns), row 0 the lowest: line integrals, or raw counts where ``flats`` are given.
    geometry: distances and pixels in mm.
    angles_deg: (F,) the gantry's in degrees, as each frame's first line opens; 0 with the source on +x, counterclockwise
    seen from above (+z). A sample that turns has the opposite sign.
    exposure_deg: the arc of one line's exposure, below 0 for a gantry that turns clockwise.
    readout_ratio: readout over exposure time, from the first line's opening to the last's; 0 is a global shutter.
    readout: what is read out at one time, "rows" or "columns". readout_direction: 1 index 0 first, -1 last.
    exposure_s: of one line, s; only files and times in plots show it.
    flats, darks: (n, rows, columns) counts without an object, and without a beam (0 when None).
    mask: (rows, columns) or (F, rows, columns), non-zero where a pixel must not be used.
    quantity: what ``frames`` hold, "attenuation", "transmission" or "counts", where ``flats`` do not say it.
    grid: the cube that a full turn sees, no higher than the panel does, in voxels of one pixel at the axis, when None.
    others: ``detector_model`` ("log", "intensity"), ``reference`` (z, y, x) in 1/mm, ``title``, ``lag``, as in ``Scan``.

    Raises InputError for shapes that do not fit, numbers out of range, and angles that turn against the exposure.
    """
    checks.one_of("readout", readout, AXES)
    checks.within("readout_ratio", readout_ratio, 0, 1000)
    checks.within("exposure_deg", exposure_deg, -3600, 3600)
    checks.positive("exposure_s", exposure_s)
    if exposure_deg == 0:
        raise InputError(
            "exposure_deg", "0", "an arc other than 0", "use static_scan for a gantry that stops"
        )
    pixels = _pixels(frames, geometry, flats, darks, mask, quantity)
    start_deg = checks.numbers("angles_deg", angles_deg, (len(pixels.values),))
    turned_deg = np.unwrap(start_deg, period=360.0)
    steps = np.diff(turned_deg) / exposure_deg
    if np.all(steps < 0) and 0 < np.abs(np.diff(turned_deg)).max(initial=0) < _CLEAR_STEP_DEG:
        remedy = f"write exposure_deg={-exposure_deg:g}, or reverse the angles' sign"
        found = f"{exposure_deg:g} with angles that turn the other way"
        raise InputError("exposure_deg", found, "the sign of the angles' steps", remedy)
    shutter = Shutter(exposure_s, readout_ratio * exposure_s, readout, readout_direction)
    in_turn = np.all(steps > 0)
    _warn_of_angles(turned_deg, steps.min(initial=np.inf) if in_turn else np.inf, readout_ratio)
    exposures = (
        (turned_deg - turned_deg[:1]) / exposure_deg
        if in_turn
        else np.arange(len(start_deg)) * (1 + readout_ratio)
    )
    start_s, first = exposures * exposure_s, np.deg2rad(start_deg)
    orbit = CircularOrbit(geometry, FrameSweeps(start_s, exposure_s, first, first + np.deg2rad(exposure_deg)))
    return _scan(pixels, orbit, shutter, start_s, grid, True, others)


def static_scan(
    frames: "ArrayLike",
    geometry: ConeGeometry,
    angles_deg: "ArrayLike",
    *,
    flats: "ArrayLike | None" = None,
    darks: "ArrayLike | None" = None,
    mask: "ArrayLike | None" = None,
    quantity: str | None = None,
    grid: Grid | None = None,
    **others: Any,
) -> Scan:
    """A scan whose gantry stops for every frame, from arrays.

    frames: (F, rows, columns), row 0 the lowest. geometry: distances and pixels in mm. angles_deg: (F,) the gantry's, from
    +x, counterclockwise seen from above. flats, darks, mask, quantity, grid, others: as of ``fly_scan``.

    Raises InputError for shapes that do not fit and numbers out of range.
    """
    pixels = _pixels(frames, geometry, flats, darks, mask, quantity)
    angle_deg = checks.numbers("angles_deg", angles_deg, (len(pixels.values),))
    _warn_of_angles(angle_deg)
    angle_rad = np.deg2rad(angle_deg)
    start_s = np.arange(len(angle_rad), dtype=np.float64)
    orbit = CircularOrbit(geometry, FrameSweeps(start_s, 0.0, angle_rad, angle_rad))
    return _scan(pixels, orbit, Shutter(0.0), start_s, grid, False, others)


def _warn_of_angles(angle_deg: np.ndarray, least_step: float = np.inf, readout_ratio: float = 0.0) -> None:
    """Says what angles (F,) look like that are radians, and what no panel does; ``least_step``: of the shortest step, how
    many exposures it has.
    """
    span_deg = float(np.ptp(angle_deg))
    if len(angle_deg) >= _MANY and 0 < span_deg <= _TURN_RAD * (1 + _SLACK):
        log.warning("angles_deg: %d frames within %.4g°: are they radians? np.rad2deg(angles)", len(angle_deg), span_deg)
    elif least_step < 1 - _SLACK:
        found = "angles_deg: frames follow each other within %.3g of an exposure: a line would open again while it is open"
        log.warning(found + "; expected steps of exposure_deg or more, but where turns are sorted by angle", least_step)
    elif np.rad2deg(1 - _SLACK) < least_step < np.inf:
        log.warning("exposure_deg: 1/%.3g of the step between frames: is it in radians? np.rad2deg(exposure)", least_step)
    elif readout_ratio > least_step * (1 + _SLACK):
        found = "readout_ratio: readout takes %.4g of the time between frames: a frame would be read while the last one is"
        log.warning(found + "; is it in percent?", readout_ratio / least_step)


def _warn_of_transmission(frames: np.ndarray) -> None:
    """Says what frames (F, rows, columns) look like that are 1 in air, at their left and right borders, and less within."""
    border, brighter = np.median(frames[..., [0, -1]]), np.count_nonzero(frames > 1 + _AIR_SLACK)
    if abs(border - 1) < _AIR_SLACK and brighter < 0.01 * frames.size and np.min(frames) < 1 - _AIR_SLACK:
        log.warning('frames: 1 at their borders, and less within: are they transmissions? quantity="transmission"')


def _pixels(
    frames: "ArrayLike",
    geometry: object,
    flats: "ArrayLike | None",
    darks: "ArrayLike | None",
    mask: "ArrayLike | None",
    quantity: str | None,
) -> LineIntegrals:
    """Frames of any quantity as line integrals, with the pixels not to be used."""
    if not isinstance(geometry, ConeGeometry):
        raise InputError("geometry", checks.shown(geometry), "a ConeGeometry")
    panel = geometry.detector_shape
    values = _stack("frames", frames, panel)
    flat, dark = (
        None if s is None else _stack(name, s, panel) for name, s in (("flats", flats), ("darks", darks))
    )
    if quantity is not None:
        checks.one_of("quantity", quantity, QUANTITIES)
    held = quantity or ("attenuation" if flat is None else "counts")
    if held == "counts" and flat is None:
        raise InputError("flats", "None beside counts", "(n, rows, columns) counts without an object")
    if held != "counts" and not (flat is None and dark is None):
        raise InputError(
            "flats, darks", f"some beside {held}", "both, or flats alone, beside counts", "leave them out"
        )
    if quantity is None and flat is None:
        check_not_counts(values, 'give flats=, or quantity="attenuation"', mask)
        _warn_of_transmission(values)
    found = line_integrals("frames", values, ImportOptions(), flats=flat, darks=dark, custom=held)
    if mask is None:
        return found
    own = np.asarray(mask) != 0
    if own.shape not in (panel, values.shape):
        raise InputError("mask", f"shape {own.shape}", f"{panel} or {values.shape}")
    if own.all():
        expected = "non-zero where a pixel must not be used"
        raise InputError("mask", "every pixel masked", expected, "turn it round")
    return replace(found, mask=own if found.mask is None else own | found.mask)


def _scan(
    pixels: LineIntegrals, orbit: CircularOrbit, shutter: Shutter, start_s: np.ndarray, grid: Grid | None, is_fly: bool,
    others: dict[str, Any],
) -> Scan:  # fmt: skip
    check_others(others)
    if "pixel_mask" in others:
        raise InputError("pixel_mask", "an option of Scan itself", "mask", "write mask=")
    where = orbit.geometry, orbit, shutter, start_s, grid or default_grid(orbit.geometry), is_fly
    facts = {**pixels.applied, **others.pop("provenance", {})}
    return Scan(pixels.values, *where, pixel_mask=pixels.mask, saturation=pixels.saturation, provenance=facts, **others)


def _stack(name: str, frames: "ArrayLike", panel: tuple[int, int]) -> np.ndarray:
    """Frames (n, rows, columns) of real numbers."""
    stack = checks.real_array(name, frames)
    checks.shape(name, stack, (None, *panel))
    if len(stack) == 0:
        raise InputError(name, "no frame", "at least one")
    return stack
