"""Summarises a scan in two or three lines, and finds numbers that no scanner has, such as lengths in a wrong unit."""

import logging
import math
from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl.acquisition.geometry import Geometry, ParallelGeometry, field_of_view_mm, towards_source
from phyradgs_cl.acquisition.readout import Named
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid

if TYPE_CHECKING:
    from phyradgs_cl.acquisition.scan import Scan

log = logging.getLogger(__name__)
OPAQUE = 50.0  # no panel can measure a larger line integral
_BRIGHT, _MANY = 5.0, 0.1  # more than the fraction _MANY of pixels over _BRIGHT times as bright as air is refused
FEW = 0.01  # up to this fraction of pixels above OPAQUE is ignored, since some pixels of a panel may be broken
_WIDEST_DEG = 120.0  # a fan or cone angle above this is refused: dental scanners have 30°, nano-CT 60°
_LARGEST_PITCH_MM = 5.0  # pixels larger than this are not real, so they are named as the cause of too wide a fan
_LEAST_DISTANCE_MM = 10.0  # a panel nearer to the source is not real, so distances are named as the cause of too wide a fan
_WRONG_UNIT = 100.0  # a readout over this many frame times is refused: a number in ms, read as s, gives hundreds
_SHORT_READOUT_S = 0.5e-3  # a shorter readout of at least _MANY_LINES lines causes a warning: real panels take some ms
_MANY_LINES = 100
_SLOW_FPS = 2.0  # a lower frame rate causes a warning if the gantry turns by more than _LARGE_STEP_DEG between frames
_LARGE_STEP_DEG = 10.0
_LEAST_LIT = 0.25  # a low frame rate causes a warning only if (exposure + readout) / (frame time) is below this
_TIMES = 17  # number of times at which angles of an exposure are computed: no gantry makes half a turn between two of them
_SLACK = 1e-3  # relative tolerance of times and angles, because users and files round them
_MOST_RAD = 20 * np.pi  # angles that span more than these ten turns are most likely in another unit
_MANY_FRAMES = 10  # fewer frames may lie within a few degrees on purpose, so they cause no warning about radians


def summary(scan: "Scan") -> str:
    """Returns a line about a scan's timing, a line about its sizes and, for a fly-scan, a line about its blur. Values that
    the provenance lists as assumed are marked "(assumed)"."""
    return "\n".join(filter(None, (_timing(scan), _sizes(scan), blur_line(scan))))


def blur_facts(scan: "Scan") -> dict[str, float]:
    """Returns ``blur_at_rim_px`` and ``blur_at_half_radius_px`` of a fly-scan, in columns; {} for a gantry at rest.

    The blur is Δθ times the radius on the panel, in columns. Δθ is the arc of an exposure in rad. A point at radius r moves
    by r·Δθ. Where the point moves at right angles to the ray, its image moves by M·r·Δθ, with the magnification M. M·r is
    the image's largest distance from the axis. This is the first order in r/R, with R from source to axis: a point nearer
    to the source blurs up to R/(R − r) times as much, a point nearer to the panel down to R/(R + r) times as much.

    Δθ is the arc while a line is open and the beam is on, as the median over the frames. The rim is the default grid's:
    as far from the axis as the panel's farther side sees."""
    if not scan.is_fly:
        return {}
    windows_s = scan.shutter.line_windows_s(scan.lines)
    lit_s = windows_s[np.argmax(np.diff(windows_s)[:, 0])]
    angle_rad = _source_angle_rad(scan, *lit_s)
    arc_rad = abs(float(np.median(angle_rad[:, -1] - angle_rad[:, 0])))
    columns = scan.geometry.detector_shape[1]
    aside = abs(scan.geometry.detector_offset_mm[1] / scan.geometry.pixel_size_mm[1])
    rim_px = arc_rad * (columns / 2 + aside)
    return {"blur_at_rim_px": rim_px, "blur_at_half_radius_px": rim_px / 2}


def blur_line(scan: "Scan") -> str:
    """Returns a line such as "blur at the rim: 1.4 px, at half radius 0.7 px", or "" for a gantry at rest."""
    facts = blur_facts(scan)
    return "blur at the rim: {:.2g} px, at half radius {:.2g} px".format(*facts.values()) if facts else ""


def _cone_deg(geometry: Geometry) -> tuple[float, float]:
    """Returns the full cone angle (along v) and fan angle (along u) in degrees; 0 in a parallel beam."""
    if isinstance(geometry, ParallelGeometry):
        return 0.0, 0.0
    sides = zip(geometry.detector_shape, geometry.pixel_size_mm, geometry.detector_offset_mm, strict=True)
    ends_mm = [[offset - count * pitch / 2, offset + count * pitch / 2] for count, pitch, offset in sides]
    low, high = np.rad2deg(np.arctan2(ends_mm, geometry.source_to_detector_mm)).T
    cone, fan = (high - low).tolist()
    return cone, fan


def _frame_time_s(scan: "Scan") -> float:
    """Returns the median time in s from a frame's start to the next frame's; NaN for a single frame."""
    return float(np.median(np.diff(scan.frame_start_s))) if scan.frames > 1 else math.nan


def _source_angle_rad(scan: "Scan", first_s: float, last_s: float) -> np.ndarray:
    """Returns the source's angles (F, 17) in rad about the axis, without jumps by a turn, at even times from ``first_s`` to
    ``last_s`` after each frame's start. In a parallel beam they are the angles against the direction of the rays."""
    delay_s = np.linspace(first_s, last_s, _TIMES)
    poses = np.stack([scan.trajectory.pose(f, t + delay_s) for f, t in enumerate(scan.frame_start_s)])
    source = towards_source(poses, scan.is_parallel)
    return np.asarray(np.unwrap(np.arctan2(source[..., 1], source[..., 0])))


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
    angle_rad = _source_angle_rad(scan, 0.0, shutter.exposure_s)
    arc_deg = abs(float(np.rad2deg(np.median(angle_rad[:, -1] - angle_rad[:, 0]))))
    parts.append(f"exposure {arc_deg:.4g}° in " + marked(f"{1000 * shutter.exposure_s:.4g} ms", "exposure"))
    if "angles" in assumed:
        parts.append(marked("angles as each frame opens", "angles"))
    averaged = "line integrals" if scan.detector_model == "log" else "intensity"
    return "timing: " + "; ".join([*parts, marked(f"averages {averaged}", "average")])


def _sizes(scan: "Scan") -> str:
    cone, fan = _cone_deg(scan.geometry)
    seen_mm = tuple(np.ptp(field_of_view_mm(scan.geometry), axis=1))
    voxel_mm = scan.grid.voxel_size_mm
    beam = "parallel beam" if scan.is_parallel else f"fan {fan:.3g}°, cone {cone:.3g}°"
    return (
        f"sizes: field of view {_joined(seen_mm)} mm (z, y, x), {beam}, voxels "
        f"{_joined(voxel_mm[:1] if len(set(voxel_mm)) == 1 else voxel_mm)} mm, largest line integral {_largest(scan):.3g}"
    )


def _largest(scan: "Scan") -> float:
    return float(np.max(scan.projections, where=scan.valid, initial=-np.inf))


def _joined(values: tuple[float, ...]) -> str:
    return " × ".join(f"{value:.4g}" for value in values)


def check_plausible(scan: "Scan", named: Named = str, is_timed: bool = True) -> None:
    """Raises InputError for sizes and times that no scanner has, and for line integrals so large that they must be counts,
    or so far below 0 that they must be of percents, or of wrong flats.

    Warns of times that are probably in a wrong unit, angles that look like radians, and line integrals that may be counts.
    named: translates ``source_to_axis_mm``, ``source_to_detector_mm``, ``pixel_size_mm``, ``grid``, ``readout_s``,
    ``exposure_s``, ``frame_time_s``, ``angles`` and ``quantity`` to what the user wrote. is_timed: False if nobody stated
    times, so that the frame rate means nothing."""
    _check_panel(scan.geometry, named)
    _check_voxels(scan.grid, scan.geometry, named("grid"))
    angle_deg = np.rad2deg(np.unwrap(_source_angle_rad(scan, 0.0, scan.shutter.exposure_s)[:, 0]))
    looks_like_radians = _warn_of_radians(angle_deg, named("angles"))
    if scan.is_fly and scan.frames > 1 and not looks_like_radians:
        exposure_s, frame_s = scan.shutter.exposure_s, _frame_time_s(scan)
        if exposure_s > (1 + _SLACK) * frame_s:
            raise _longer_than_a_frame(named("exposure_s"), f"exposure of {exposure_s:.4g} s", exposure_s, frame_s)
        _check_readout(scan, named("readout_s"))
        if is_timed:
            _warn_of_slow_frames(scan, angle_deg, named("frame_time_s"))
    _check_opaque(scan, named("quantity"))
    check_brightness(scan.projections, scan.valid, named("quantity"))


def check_brightness(projections: np.ndarray, valid: np.ndarray, subject: str) -> None:
    """Raises InputError about ``subject`` if over a tenth of the line integrals (F, v, u) are below −ln 5, as in pixels over
    5 times as bright as air. valid: True where a line integral counts, in an array that broadcasts."""
    pairs = [(frame, ok) for frame, ok in zip(projections, np.broadcast_to(valid, projections.shape), strict=True)]
    bright = sum(np.count_nonzero((frame < -math.log(_BRIGHT)) & ok) for frame, ok in pairs)
    share = bright / max(1, sum(np.count_nonzero(ok) for _, ok in pairs))
    if share > _MANY:
        least = min(float(np.min(frame, where=ok, initial=0.0)) for frame, ok in pairs)
        found = f"line integrals down to {least:.3g}, {100 * share:.3g} % of pixels over {_BRIGHT:g} times as bright as air"
        remedy = "divide percents by 100; of counts correct the flats or the flat value; or reverse the sign"
        raise InputError(subject, found, "−ln(transmission), which is 0 in air", remedy)


def _check_opaque(scan: "Scan", subject: str) -> None:
    """Raises InputError if over half of the line integrals are above 50, more than a panel can measure: such values are
    counts, which are large in air. Warns if over 1 % of them are."""
    pairs = zip(scan.projections, scan.valid, strict=True)
    counts = [(np.count_nonzero(frame[valid] > OPAQUE), np.count_nonzero(valid)) for frame, valid in pairs]
    opaque, valid_pixels = np.sum(counts, axis=0).tolist()
    largest = _largest(scan)
    if opaque > valid_pixels / 2:
        found = f"line integrals of up to {largest:.3g}, most above {OPAQUE:g}"
        remedy = "say counts, with flats; line integrals in another unit: divide them by it first"
        raise InputError(subject, found, "−ln(counts / flats), which is below 20 behind most objects", remedy)
    if opaque > FEW * valid_pixels:
        text = "line integrals of up to %.3g: no panel sees through more than %g; are they counts? say %s"
        log.warning(text, largest, OPAQUE, subject)


def _warn_of_radians(angle_deg: np.ndarray, subject: str) -> bool:
    """Returns whether the angles (F,) of at least 10 frames lie within 2π degrees but differ. Warns then that they may be in
    radians."""
    span_deg = float(np.ptp(angle_deg))
    looks_so = len(angle_deg) >= _MANY_FRAMES and 0 < span_deg <= 2 * np.pi * (1 + _SLACK)
    if looks_so:
        text = "%s: %d frames within %.4g°: are they radians? Give degrees"
        log.warning(text, subject, len(angle_deg), span_deg)
    return looks_so


def question_unit(angle_rad: np.ndarray, subject: str, unit: str) -> None:
    """Warns of angles (F,) in rad that span more than ten turns, and so may not be in their ``unit``, "deg" or "rad"."""
    span_rad = float(np.ptp(angle_rad)) if len(angle_rad) else 0.0
    if span_rad > _MOST_RAD:
        over = f"{span_rad:.4g} rad: are they degrees? np.deg2rad(angles)"
        if unit == "deg":
            over = f"{np.rad2deg(span_rad):.4g}°: are they in degrees? Else convert them, or name their unit"
        log.warning("%s: %d frames over %s", subject, len(angle_rad), over)


def _check_panel(geometry: Geometry, named: Named) -> None:
    """Raises InputError for a fan or cone above 120°. The message names the distances if the panel is less than 10 mm from
    the source and pixels are at most 5 mm large; else it names the pixels."""
    widest_deg = max(_cone_deg(geometry))
    if isinstance(geometry, ParallelGeometry) or widest_deg <= _WIDEST_DEG:
        return
    subject = named("pixel_size_mm")
    found = f"pixels of {' × '.join(f'{pitch:g}' for pitch in geometry.pixel_size_mm)} mm"
    remedy = "give the pitch of one pixel in mm: not in µm, and not the panel's width"
    are_pixels_real = max(geometry.pixel_size_mm) <= _LARGEST_PITCH_MM
    if are_pixels_real and geometry.source_to_detector_mm < _LEAST_DISTANCE_MM:
        subject = f"{named('source_to_axis_mm')}, {named('source_to_detector_mm')}"
        found = f"{geometry.source_to_axis_mm:g} and {geometry.source_to_detector_mm:g} mm"
        remedy = "give distances in mm: not in m or cm"
    found += f", a panel seen under {widest_deg:.0f}°"
    raise InputError(subject, found, f"less than {_WIDEST_DEG:.0f}°", remedy)


def _check_voxels(grid: Grid, geometry: Geometry, subject: str) -> None:
    half_mm = field_of_view_mm(geometry)[1, 1]
    columns = geometry.detector_shape[1]
    if columns > 2 and min(grid.voxel_size_mm) > half_mm:
        shape = "×".join(map(str, grid.shape))
        found = f"{shape} voxels of {min(grid.voxel_size_mm):.4g} mm"
        expected = f"voxels of about {2 * half_mm / columns:.3g} mm, in a field of view of {2 * half_mm:.4g} mm"
        raise InputError(subject, found, expected, "correct the number of voxels, or the unit of a length")


def _check_readout(scan: "Scan", subject: str) -> None:
    readout_s, frame_s = scan.shutter.readout_s, _frame_time_s(scan)
    refusal = _longer_than_a_frame(subject, f"readout of {readout_s:.4g} s", readout_s, frame_s)
    if readout_s > _WRONG_UNIT * frame_s:
        raise refusal
    if readout_s > (1 + _SLACK) * frame_s:
        log.warning("%s: %s: a line would open again before it is read; is its unit right?", subject, refusal.found)
    if 0 < readout_s < _SHORT_READOUT_S and scan.lines >= _MANY_LINES:
        text = "%s: readout of %.3g ms for %d lines: panels take some milliseconds; is its unit right?"
        log.warning(text, subject, 1000 * readout_s, scan.lines)


def _longer_than_a_frame(subject: str, stated: str, time_s: float, frame_s: float) -> InputError:
    found = f"{stated}, {time_s / frame_s:.3g} times the {frame_s:.3g} s from frame to frame"
    return InputError(subject, found, "at most one frame's time", "correct its unit, or the frame time's")


def _warn_of_slow_frames(scan: "Scan", angle_deg: np.ndarray, subject: str) -> None:
    """Warns of fewer than 2 frames per second if the gantry turns by more than 10° between frames and lines are open for
    less than a quarter of the time. angle_deg (F,): the frames' angles."""
    frame_s, step_deg = _frame_time_s(scan), float(np.median(np.abs(np.diff(angle_deg))))
    is_dark = scan.shutter.span_s < _LEAST_LIT * frame_s
    if is_dark and _SLOW_FPS * frame_s > 1 and step_deg > _LARGE_STEP_DEG:
        log.warning("%s: %.3g fps and %.3g° from frame to frame; is the rate right?", subject, 1 / frame_s, step_deg)
