"""Hypotheses about what is wrong in a scan: units of sizes, steps of the angles, missing frames, mirrored frames."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phyradgs_cl.acquisition import ParallelGeometry, Scan
from phyradgs_cl.acquisition.altered import variants
from phyradgs_cl.acquisition.altered.angles import start_azimuths_rad, wrapped
from phyradgs_cl.acquisition.altered.coarse import coarse_grid
from phyradgs_cl.acquisition.geometry import default_grid
from phyradgs_cl.check.finding import MIRROR_U, MIRROR_V, PIXEL_SIZES
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.fits import axis

SIZE_FACTORS = (10.0, 0.1, 1e3, 1e-3)
LEAST_REDUNDANCY = 0.5  # if a full turn measures the rays of fewer than this fraction of the columns twice, any size fits
_UNITS = {10.0: " (in cm, read as mm?)", 1e3: " (in m, read as mm?)", 1e-3: " (in µm, read as mm?)"}
_FANS = (0.02, 3.0)  # range of (panel's width / panel's distance from the source) in real scanners
_GRID_FACTOR = 3.0  # a grid this many times wider or narrower than the panel's view has wrong sizes too, and is replaced
_SAME_PLACE = 1.0  # shifts of the panel that differ by less, in coarse pixels, look the same
_ARC_PERCENTS = (-5, -4, -3, -2, -1, 1, 2, 3, 4, 5)  # changes of the angle between views, in percent, that are tried


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """What may be wrong in a scan: a description, advice, and a function that returns the scan corrected for it.

    factor: (pixel size of the hypothesis) / (stated pixel size). Hypotheses with the same factor other than 1 differ only by
    the panel's shift."""

    text: str
    advice: str
    scan: Callable[[], Scan]
    factor: float = 1.0


def stated_redundancy(scan: Scan) -> float:
    """Returns the fraction of columns whose rays a full turn measures twice, by the stated offset. It is negative if the
    axis misses the panel."""
    geometry = scan.geometry
    return 1 - 2 * abs(geometry.detector_offset_mm[1]) / (geometry.pixel_size_mm[1] * geometry.detector_shape[1])


def has_axis_near_edge(scan: Scan) -> bool:
    """Returns whether the panel sees the axis, but so near its edge that less than half of the rays are measured twice."""
    return 0 <= stated_redundancy(scan) < LEAST_REDUNDANCY


def shifts_for_sense_px(scan: Scan) -> tuple[float, float]:
    """Returns how far the panel may be shifted, (lowest, highest) in pixels of the recorded scan, to compare senses of
    rotation.

    If the axis is near the panel's edge, the panel's middle may only move towards the axis. If it moved away, fewer rays
    would be measured twice, and any angles would fit."""
    offset_mm, pitch_mm = scan.geometry.detector_offset_mm[1], scan.geometry.pixel_size_mm[1]
    if not has_axis_near_edge(scan):
        return axis.ANYWHERE
    across_px = 2 * abs(offset_mm) / pitch_mm * variants.altered_trajectory(scan).blocks[1]
    return (-across_px, 0.0) if offset_mm > 0 else (0.0, across_px)


def frame_number(scan: Scan, frame: int) -> int:
    """Returns a frame's number in the file, counted from 0."""
    return int(variants.altered_trajectory(scan).frame_numbers(scan)[frame])


def of_scan(scan: Scan, stated: Scan) -> Iterator[Hypothesis]:
    """Yields hypotheses about the whole coarse ``scan``: sizes in another unit, mirrored frames. stated: the full scan."""
    yield from _other_units(scan, stated)
    advice = "import again with the other {}, and check again"
    offset_v_mm, offset_u_mm = stated.geometry.detector_offset_mm
    if offset_u_mm or stated.shutter.axis == "columns":
        text = "frames fit if they are mirrored in u (or with rotation, detector_offset and readout the other way)"
        yield Hypothesis(text, advice.format(MIRROR_U), partial(variants.mirrored, scan, "u"))
    if offset_v_mm:
        text = "frames fit if they are mirrored in v (or with detector_offset along v and readout the other way)"
        yield Hypothesis(text, advice.format(MIRROR_V), partial(variants.mirrored, scan, "v"))


def _other_units(scan: Scan, stated: Scan) -> Iterator[Hypothesis]:
    """Yields hypotheses of pixel sizes or distances in other units. Frames show only (pixel size) / (panel's distance). The
    panel's offset may decide which of the two is wrong. ``scan`` is coarse, ``stated`` the full scan."""
    geometry = stated.geometry
    if isinstance(geometry, ParallelGeometry):
        return  # in a parallel beam, other sizes only scale the object
    fan = geometry.detector_shape[1] * geometry.pixel_size_mm[1] / geometry.source_to_detector_mm
    offset_px = np.abs(np.array(geometry.detector_offset_mm) / geometry.pixel_size_mm)
    for factor in SIZE_FACTORS:
        if not _FANS[0] < factor * fan < _FANS[1]:
            continue
        sizes, distances = _times("pixel sizes", factor), _times("distances", 1 / factor)
        correct_sizes, correct_distances = f"correct {PIXEL_SIZES}", "correct the distances"
        with_axis, with_offset = (partial(_with_sizes, scan, stated, factor, keeps_axis) for keeps_axis in (True, False))
        shift_px = offset_px * abs(1 - 1 / factor)
        if (shift_px < _SAME_PLACE * np.array(variants.altered_trajectory(scan).blocks)).all():
            text = f"frames fit with {sizes}, or with {distances}: they do not tell which"
            yield Hypothesis(text, f"{correct_sizes}, or {correct_distances}", with_axis, factor)
            continue
        if 1 - (1 - stated_redundancy(stated)) / factor >= LEAST_REDUNDANCY:
            yield Hypothesis(f"frames fit with {sizes}, detector_offset as stated", correct_sizes, with_offset, factor)
        if stated_redundancy(stated) >= LEAST_REDUNDANCY:
            text = f"frames fit with {distances}, or with pixel sizes and detector_offset {factor:g} times as large"
            yield Hypothesis(text, f"{correct_distances}, or pixel sizes and detector_offset", with_axis, factor)


def _times(name: str, factor: float) -> str:
    return f"{name} {factor:g} times as large{_UNITS.get(round(factor, 6), '')}"


def _with_sizes(scan: Scan, stated: Scan, factor: float, keeps_axis: bool) -> Scan:
    """Returns the coarse ``scan`` with pixels ``factor`` times as large as ``stated``, the full scan, says, and a fitting
    grid. keeps_axis: True keeps the detector column to which the rotation axis projects; False keeps the offset in mm."""
    v_mm, u_mm = stated.geometry.pixel_size_mm
    off_v_mm, off_u_mm = (offset * (factor if keeps_axis else 1) for offset in stated.geometry.detector_offset_mm)
    pixel_size_mm = (factor * v_mm, factor * u_mm)
    geometry = replace(stated.geometry, pixel_size_mm=pixel_size_mm, detector_offset_mm=(off_v_mm, off_u_mm))
    blocks = variants.altered_trajectory(scan).blocks
    panel = replace(scan.geometry, pixel_size_mm=(blocks[0] * pixel_size_mm[0], blocks[1] * pixel_size_mm[1]))
    grid = coarse_grid(_matching_grid(stated, default_grid(geometry)), panel)
    return replace(variants.resized(scan, factor, keeps_axis), geometry=panel, grid=grid)


def _matching_grid(stated: Scan, panel_grid: Grid) -> Grid:
    """Returns ``panel_grid`` if the stated grid was derived from the panel, or if the longest sides of the two grids differ
    by a factor of 3 or more; else the stated grid."""
    ratio = max(stated.grid.size_mm) / max(panel_grid.size_mm)
    is_derived = stated.grid == default_grid(stated.geometry)
    return panel_grid if is_derived or not 1 / _GRID_FACTOR < ratio < _GRID_FACTOR else stated.grid


def of_frames(scan: Scan, shifted_scan: Scan) -> Iterator[Hypothesis]:
    """Yields hypotheses about a coarse scan: other steps of its angles, and exchanged pixel sizes (of ``shifted_scan``, its
    copy with the best shift of the panel)."""
    yield from _other_steps(scan)
    v, u = scan.geometry.pixel_size_mm
    if not scan.is_parallel and abs(v / u - 1) > 0.02:  # parallel rays: another object would fit as well
        text, advice = "pixel sizes fit if v and u are exchanged", f"exchange {PIXEL_SIZES}"
        yield Hypothesis(text, advice, partial(variants.stretched, shifted_scan, u / v, v / u))


def _azimuths(scan: Scan) -> np.ndarray:
    """Returns each frame's angle (F,) in rad minus the first frame's. Whole turns between frames are kept only if the
    trajectory states angles."""
    trajectory = variants.altered_trajectory(scan)
    angle_rad = getattr(trajectory.base, "angle_rad", None)
    if angle_rad is None:
        angles = np.unwrap(start_azimuths_rad(scan))
    else:
        starts = zip(trajectory.frame_numbers(scan), scan.frame_start_s, strict=True)
        angles = np.array([float(angle_rad(int(number), np.array([start_s]))[0]) for number, start_s in starts])
    return angles - angles[0]


def _other_steps(scan: Scan) -> Iterator[Hypothesis]:
    from_first = _azimuths(scan)
    sense = -1.0 if variants.altered_trajectory(scan).is_reversed else 1.0
    total_deg = float(np.rad2deg(abs(from_first[-1])))
    radian_deg = float(np.degrees(1.0))
    steps = {
        radian_deg: "angles in radians were taken for degrees",
        1 / radian_deg: "angles in degrees were taken for radians",
        0.5: "the step of the angles is half of what is stated",
        2.0: "the step of the angles is twice what is stated",
    }
    for percent in _ARC_PERCENTS:
        sign = "smaller" if percent < 0 else "larger"
        steps[1 + percent / 100] = f"the step of the angles is about {abs(percent)} % {sign} than stated"
    for factor, text in steps.items():
        span = f"the frames span {factor * total_deg:.4g}°, not {total_deg:.4g}°"
        advice = f"{span}: correct rotation_angle, its unit or its step"
        turns_rad = sense * (factor - 1) * from_first
        yield Hypothesis(text, advice, partial(variants.turned, scan, turns_rad, factor))


def nearly_sized(scan: Scan, factor: float) -> Scan:
    """Returns the scan with pixels ``factor`` times as large, the axis in the same column, and the grid of ``stretched``."""
    grid = variants.stretched(scan, factor, factor).grid
    return replace(variants.resized(scan, factor, keeps_axis=True), grid=grid)


def of_gap(scan: Scan, stated: Scan, at: int, is_missing: bool) -> Hypothesis:
    """Returns the hypothesis that a frame is missing before the frame with index ``at`` of a coarse scan, or that one is
    there twice. Its correction gives each later frame the angle of the frame behind it in ``stated``, the full scan, or of
    the frame before it."""
    sense = -1.0 if variants.altered_trajectory(scan).is_reversed else 1.0
    steps_rad = wrapped(np.diff(start_azimuths_rad(stated)))  # (n,): from each frame of the full scan to the one behind it
    ends_rad = np.median(steps_rad)  # beyond the last frame and the first
    numbers, frames = (variants.altered_trajectory(one).frame_numbers(one) for one in (stated, scan))
    turns_rad = np.r_[steps_rad, ends_rad] if is_missing else -np.r_[ends_rad, steps_rad]
    later_rad = sense * turns_rad[np.searchsorted(numbers, frames)] * (np.arange(scan.frames) >= at)
    text = f"a frame is missing near frame {frame_number(scan, at)} (from 0): later frames fit one step further on"
    advice = "find the missing frame, or shift the angles behind it by a step"
    if not is_missing:
        text = f"a frame is there twice near frame {frame_number(scan, at)} (from 0): later frames fit one step before"
        advice = "take the frame out, so that later ones get their own angles"
    return Hypothesis(text, advice, partial(variants.turned, scan, later_rad))
