"""Makes scans from arrays: frames, a geometry and angles."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from inspect import signature
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, FrameSweeps, Scan, Shutter
from phyradgs_cl.acquisition.geometry import GEOMETRIES, Geometry, default_grid
from phyradgs_cl.acquisition.plausible import check_plausible
from phyradgs_cl.acquisition.scans_from import check_not_counts, check_others
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.acquisition.trajectory import unwrapped
from phyradgs_cl.detector.attenuation import QUANTITIES
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers.frames import LineIntegrals, line_integrals
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.removed import refuse_removed

log = logging.getLogger(__name__)
# For messages: the name of a value in the checks of a Scan, and the argument of ``fly_scan`` in which the user states it.
_ARGUMENTS = {
    "angles": "angles_deg", "exposure_s": "exposure_deg", "frame_time_s": "exposure_s", "readout_s": "readout_ratio",
    "readout_axis": "readout",
    "source_to_axis_mm": "geometry.source_to_axis_mm", "source_to_detector_mm": "geometry.source_to_detector_mm",
}  # fmt: skip
_SLACK = 1e-3  # relative tolerance of the angle between frames and of an exposure's arc, since users round angles
_CLEAR_STEP_DEG = 90.0  # between views this far apart or more, the gantry may have turned either way


def fly_scan(
    frames: "ArrayLike", geometry: "Geometry", angles_deg: "ArrayLike", *, exposure_deg: float,
    readout_ratio: float = 0.0, readout: str = "rows", readout_direction: int = 1, exposure_s: float | None = None,
    flats: "ArrayLike | None" = None, darks: "ArrayLike | None" = None, mask: "ArrayLike | None" = None,
    quantity: str | None = None, grid: Grid | None = None, **others: Any,
) -> Scan:
    """Returns a scan whose gantry never stops, from arrays.

    frames: (F, rows, columns), row 0 the lowest: line integrals, or raw counts together with ``flats``.
    geometry: of a cone or a parallel beam, in mm.
    angles_deg: (F,) the gantry's angle in degrees when a frame's first line opens; 0 with the source on +x,
    counterclockwise seen from above (+z). A sample that turns has the opposite sign.
    exposure_deg: how far the gantry turns while a line is exposed, degrees per second times exposure_s; below 0 if it turns
    clockwise. readout_ratio: readout over exposure time; readout lasts from the opening of the first line to that of the
    last, and 0 is a global shutter. readout: which lines are read one after the other, "rows" or "columns".
    readout_direction: 1 reads index 0 (the lowest row, the left column) first, -1 last. exposure_s: how long a line is
    exposed, in s; None means 1.
    flats, darks: (n, rows, columns) or (rows, columns), counts without an object, and without a beam (None means 0).
    mask: (rows, columns) or (F, rows, columns), non-zero for pixels that must not be used.
    quantity: what ``frames`` are, "attenuation", "transmission" or "counts"; None takes counts if there are ``flats``.
    grid: None takes the field of view of a full turn, in a cone beam at most as high as wide. Its voxels have a pixel's size
    at the axis.
    others: ``detector_model`` ("log", "intensity"), ``reference`` (z, y, x) in 1/mm, ``title``, ``lag``, as in ``Scan``.

    Raises InputError for shapes that do not fit, numbers out of range or implausible, contradictory arguments, and angles
    that turn the other way than ``exposure_deg``."""
    for name in others:
        refuse_removed(f"fly_scan.{name}", name)
    check_others(others, _keywords(fly_scan))
    checks.one_of("readout", readout, AXES)
    checks.within("readout_ratio", readout_ratio, 0, 1000)
    checks.within("exposure_deg", exposure_deg, -3600, 3600)
    if exposure_deg == 0:
        raise InputError("exposure_deg", "0", "an arc other than 0", "use static_scan for a gantry that stops")
    is_timed, exposure_s = exposure_s is not None, 1.0 if exposure_s is None else exposure_s
    checks.positive("exposure_s", exposure_s)
    # NumPy's numbers of 8 or 16 bits would overflow and lose digits below
    exposure_deg, readout_ratio, exposure_s = float(exposure_deg), float(readout_ratio), float(exposure_s)
    pixels = _pixels(frames, geometry, flats, darks, mask, quantity)
    start_deg = checks.numbers("angles_deg", angles_deg, (len(pixels.values),))
    turned_deg = unwrapped(start_deg, 360.0)
    steps = np.diff(turned_deg) / exposure_deg
    if np.all(steps < 0) and 0 < np.abs(np.diff(turned_deg)).max(initial=0) < _CLEAR_STEP_DEG:
        remedy = f"write exposure_deg={-exposure_deg:g}, or reverse the angles' sign"
        found = f"{exposure_deg:g} with angles that turn the other way"
        raise InputError("exposure_deg", found, "the sign of the angles' steps", remedy)
    shutter = Shutter(exposure_s, readout_ratio * exposure_s, readout, readout_direction)
    start_s = np.arange(len(start_deg)) * shutter.span_s
    if np.all(steps > 0):
        start_s = (turned_deg - turned_deg[:1]) / exposure_deg * exposure_s
    first_rad = np.deg2rad(start_deg)
    last_rad = first_rad + np.deg2rad(_arcs_deg(turned_deg, exposure_deg))
    orbit = CircularOrbit(geometry, FrameSweeps(start_s, exposure_s, first_rad, last_rad))
    least_step = steps.min(initial=np.inf)
    if np.rad2deg(1 - _SLACK) < least_step < np.inf:
        log.warning("exposure_deg: 1/%.3g of the step between frames: is it in radians? np.rad2deg(exposure)", least_step)
    called = {**_ARGUMENTS, **({"exposure_s": "exposure_s"} if is_timed else {})}
    return _scan(pixels, orbit, shutter, start_s, grid, True, others, called, is_timed)


def _arcs_deg(angles_deg: np.ndarray, exposure_deg: float) -> np.ndarray:
    """Returns how far the gantry turns in each frame's exposure (F,), in degrees, negative for a clockwise turn.

    Unwrapped angles (F,) that rise and fall belong to a gantry that swings back and forth. In each frame it turns towards
    the next frame's angle, but at a reversal it may still turn the other way. Otherwise, and with any step of 90° or more,
    which cannot show the direction, all frames turn as ``exposure_deg`` states."""
    steps_deg = np.diff(angles_deg)
    arcs_deg = np.full(len(angles_deg), exposure_deg)
    is_clear = (np.abs(steps_deg) < _CLEAR_STEP_DEG).all() and (steps_deg > 0).any() and (steps_deg < 0).any()
    if not is_clear:
        return arcs_deg
    before, after = (np.append(x, y) for x, y in ((steps_deg[:1], steps_deg), (steps_deg, steps_deg[-1:])))
    reaches_next = np.abs(after) >= abs(exposure_deg) * (1 - _SLACK)
    sense = np.where((before * after > 0) | reaches_next, np.sign(after), np.sign(before))
    back = np.count_nonzero(sense * np.sign(exposure_deg) < 0)
    log.warning("angles_deg rise and fall: %d of %d frames sweep against the sign of exposure_deg", back, len(sense))
    return np.asarray(np.where(sense == 0, np.sign(exposure_deg), sense) * abs(exposure_deg))


def static_scan(
    frames: "ArrayLike", geometry: "Geometry", angles_deg: "ArrayLike", *, flats: "ArrayLike | None" = None,
    darks: "ArrayLike | None" = None, mask: "ArrayLike | None" = None, quantity: str | None = None,
    grid: Grid | None = None, **others: Any,
) -> Scan:
    """Returns a scan whose gantry stops for every frame, from arrays.

    frames: (F, rows, columns), row 0 the lowest. geometry: of a cone or a parallel beam, in mm. angles_deg: (F,) the
    gantry's angle from +x, counterclockwise seen from above. flats, darks, mask, quantity, grid, others: as in
    ``fly_scan``.

    Raises InputError for shapes that do not fit and numbers out of range."""
    check_others(others, _keywords(static_scan))
    pixels = _pixels(frames, geometry, flats, darks, mask, quantity)
    angle_rad = np.deg2rad(checks.numbers("angles_deg", angles_deg, (len(pixels.values),)))
    start_s = np.arange(len(angle_rad), dtype=np.float64)
    orbit = CircularOrbit(geometry, FrameSweeps(start_s, 0.0, angle_rad, angle_rad))
    return _scan(pixels, orbit, Shutter(0.0), start_s, grid, False, others)


def _keywords(function: Callable[..., Scan]) -> list[str]:
    return [one.name for one in signature(function).parameters.values() if one.kind is one.KEYWORD_ONLY]


def _pixels(
    frames: "ArrayLike", geometry: Geometry, flats: "ArrayLike | None", darks: "ArrayLike | None",
    mask: "ArrayLike | None", quantity: str | None,
) -> LineIntegrals:
    """Converts frames of any quantity to line integrals, with the mask of unusable pixels. Arguments as in ``fly_scan``."""
    checks.kind("geometry", geometry, GEOMETRIES, "a ConeGeometry or a ParallelGeometry")
    panel = geometry.detector_shape
    mask = None if mask is None else checks.real_array("mask", mask, "biuf")
    values = _stack("frames", frames, panel)
    flat = None if flats is None else _stack("flats", flats, panel)
    dark = None if darks is None else _stack("darks", darks, panel)
    if quantity is not None:
        checks.one_of("quantity", quantity, QUANTITIES)
    unit = quantity or ("attenuation" if flat is None else "counts")
    if unit == "counts" and flat is None:
        raise InputError("flats", "None together with counts", "(n, rows, columns) counts without an object")
    if unit != "counts" and not (flat is None and dark is None):
        expected = "both, or flats alone, together with counts"
        raise InputError("flats, darks", f"some together with {unit}", expected, "leave them out")
    if quantity is None and flat is None:
        check_not_counts(values, 'give flats=, or quantity="attenuation"', mask)
    integrals = line_integrals("frames", values, ImportOptions(), flats=flat, darks=dark, convention=unit)
    if mask is None:
        return integrals
    unusable = mask != 0
    if unusable.shape not in (panel, values.shape):
        raise InputError("mask", f"shape {unusable.shape}", f"{panel} or {values.shape}")
    if unusable.all():
        raise InputError("mask", "every pixel masked", "non-zero where a pixel must not be used", "turn it round")
    return replace(integrals, mask=unusable if integrals.mask is None else unusable | integrals.mask)


def _scan(
    pixels: LineIntegrals, orbit: CircularOrbit, shutter: Shutter, start_s: np.ndarray, grid: Grid | None, is_fly: bool,
    others: dict[str, Any], called: Mapping[str, str] = _ARGUMENTS, is_timed: bool = True,
) -> Scan:  # fmt: skip
    if "pixel_mask" in others:
        raise InputError("pixel_mask", "an option of Scan itself", "mask", "write mask=")
    where = orbit.geometry, orbit, shutter, start_s, grid or default_grid(orbit.geometry), is_fly
    facts = {**pixels.applied, **others.pop("provenance", {})}
    scan = Scan(pixels.values, *where, pixel_mask=pixels.mask, saturation=pixels.saturation, provenance=facts, **others)
    check_plausible(scan, lambda name: called.get(name, name), is_timed)
    return scan


def _stack(name: str, frames: "ArrayLike", panel: tuple[int, int]) -> np.ndarray:
    """Returns frames (n, rows, columns) of real numbers; a single flat or dark may be given as (rows, columns). Raises
    InputError for other shapes, and if there is no frame."""
    stack = checks.real_array(name, frames)
    if stack.ndim == 2 and name != "frames":
        stack = stack[None]
    checks.shape(name, stack, (None, *panel))
    if len(stack) == 0:
        raise InputError(name, "no frame", "at least one")
    return stack
