"""Checks that the panel sees the whole object, and that the scan's values are line integrals."""

import math

import numpy as np
import scipy

from phyradgs_cl.acquisition import ParallelGeometry, Scan
from phyradgs_cl.acquisition.geometry import field_of_view_mm
from phyradgs_cl.check.finding import FEWEST_COLUMNS, OK, SUSPICIOUS, Finding, outer_median, too_narrow
from phyradgs_cl.check.timing import is_full_turn
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.detector import noise_level
from phyradgs_cl.detector.noise_level import noise_rms

_LARGEST_SHARE = 0.1  # at the panel's sides, values above this fraction of the largest line integral are not air
_DISPLACED = 0.1  # a panel whose centre is off the central ray by this fraction of its width was displaced on purpose
_NOISES = 4.0  # values above this many standard deviations of the noise belong to the object
_OPAQUE = 30.0  # larger values are no line integrals, because no light would pass
_INVERTED = 0.9  # bright and dark are exchanged if (median of the outer columns) / (largest value) exceeds this
_BRIGHT = 0.05  # at most this fraction of the pixels may be brighter than the flats by more than the noise
_FRAMES = 0.1  # the object may touch a side of the panel in up to this fraction of the frames
_COVERED = 0.1  # a column shows the object if more than this fraction of its pixels shows the object
# A unit is wrong if (grid's width / width of the panel's view) or (object's width / grid's width) exceeds this.
_ANOTHER_SIZE = 5.0
_NOISE_FRAMES, _NEAR = 16, 5  # most frames in which noise is sought; side, in pixels, of the square around a pixel
# Limits of (noise) / (mean line integral) behind the object: above _MOST_NOISE noise dominates, above _NO_OBJECT_FROM there
# is no object.
_MOST_NOISE, _NO_OBJECT_FROM = 0.4, 4.0
NOISE = "noise"
NO_OBJECT, OPAQUE, TOO_BRIGHT = "no object", "opaque", "too bright"  # findings with these units end the check
CUT_OFF = "line integral at the border"  # a finding with this unit says that the object reaches beyond the panel
_QUESTION = "coverage"


def check_coverage(scan: Scan) -> Finding:
    """Checks that the panel sees the whole object, and that the scan's values can be line integrals.

    The object touches a side if the two outermost columns are above noise and above a tenth of the largest line integral.
    The columns are averaged over an eighth of the rows, and a tenth of the frames must show the object there. A displaced
    panel may cut the object on its short side. The top and bottom are not checked.

    Other findings: no object above the noise, inverted values, line integrals beyond 30, and pixels brighter than the flats.
    A size is wrong if the grid is over 5 times as wide as the panel's view, or the object over 5 times as wide as the
    grid."""
    p = np.asarray(scan.projections)
    if p.shape[2] < FEWEST_COLUMNS:
        return too_narrow(_QUESTION, "line integral")
    valid = scan.valid
    largest = float(np.percentile(p[valid], 99.9))
    noise = _NOISES * noise_level(p, valid)
    threshold = max(_LARGEST_SHARE * largest, noise)
    return _check_values(p, valid, largest, noise, threshold) or _check_sides(scan, p, valid, largest, threshold)


def find_noise(scan: Scan) -> Finding | None:
    """Returns a finding if noise dominates: if (noise of a pixel, by ``noise_rms``) / (mean line integral) behind the object
    exceeds 0.4; else None. Pixels lie behind the object where the mean over their neighbours is above a tenth of its largest
    value. Scans of 1000 photons per pixel had at most 0.29, of 30 at least 0.85. Above 4 the result is None too, because
    ``check_coverage`` finds no object."""
    some = slice(None, None, ceil_div(scan.frames, _NOISE_FRAMES))
    p, valid = np.asarray(scan.projections[some]), scan.valid[some]
    mean = scipy.ndimage.uniform_filter(np.where(valid, p, 0), (1, _NEAR, _NEAR))
    behind = valid & (mean > _LARGEST_SHARE * np.percentile(mean, 99.9))
    share = noise_rms(p, behind, valid) / float(p[behind].mean()) if behind.any() else 0.0
    if not _MOST_NOISE < share <= _NO_OBJECT_FROM:
        return None
    text = f"the noise of a pixel is {100 * share:.0f} % of the line integrals behind the object"
    advice = "expose longer, add up frames, or take coarser voxels: --size; fine detail of a volume is noise"
    return Finding(NOISE, SUSPICIOUS, share, _MOST_NOISE, "share of the line integrals", text, advice)


def _check_values(p: np.ndarray, valid: np.ndarray, largest: float, noise: float, threshold: float) -> Finding | None:
    """Returns a finding if the values p (F, v, u) cannot be line integrals of an object; else None. largest: their 99.9th
    percentile. noise: a value that noise alone does not exceed. threshold: least value of a pixel that sees the object."""
    if largest <= noise:
        text = f"no object: line integrals reach {largest:.3g}, noise {noise:.3g}"
        advice = "was the object in the beam? Are the values line integrals, larger behind more material?"
        return Finding(_QUESTION, SUSPICIOUS, largest, noise, NO_OBJECT, text, advice)
    air = outer_median(p, valid)
    if air > _INVERTED * largest:
        text = f"values are largest, {air:.3g}, beside the object"
        advice = "are these transmissions, or inverted images? Declare them: import --quantity, or quantity of the data"
        return Finding(_QUESTION, SUSPICIOUS, air, _INVERTED * largest, NO_OBJECT, text, advice)
    if largest > _OPAQUE:
        text = f"line integrals reach {largest:.3g}: one photon in {math.exp(min(largest, 700)):.1g} passes"
        advice = "are these counts, or transmissions? Declare them: import --quantity, or quantity of the data"
        return Finding(_QUESTION, SUSPICIOUS, largest, _OPAQUE, OPAQUE, text, advice)
    least = float(np.percentile(p[valid], 100 * _BRIGHT))
    if least < -threshold:
        text = f"line integrals go down to {least:.3g}: pixels are brighter than the flats"
        advice = "are the flats from this scan, with its exposure and beam? Without flats: is the flat value right?"
        return Finding(_QUESTION, SUSPICIOUS, -least, threshold, TOO_BRIGHT, text, advice)
    return None


def _check_sides(scan: Scan, p: np.ndarray, valid: np.ndarray, largest: float, threshold: float) -> Finding:
    """Returns the finding about the object at the panel's sides, and about its width compared with the grid's."""
    sides = {"left": _border(p, valid, slice(0, 2)), "right": _border(p, valid, slice(-2, None))}
    offset_mm = scan.geometry.detector_offset_mm[1]
    if is_full_turn(scan) and abs(offset_mm) >= _DISPLACED * p.shape[2] * scan.geometry.pixel_size_mm[1]:
        del sides["left" if offset_mm > 0 else "right"]  # opposite views see what a displaced panel's short side cuts off
    name, level = max(sides.items(), key=lambda item: item[1])
    width_mm, grid_mm = _width_mm(scan, p, valid, threshold), max(scan.grid.size_mm[1:])
    text = (
        f"at most {level:.3g} at the {name} border, where air is 0 and the object reaches {largest:.3g}; "
        f"it is about {width_mm:.3g} mm wide at the axis, the grid {grid_mm:.3g} mm"
    )
    panel_mm = 2 * field_of_view_mm(scan.geometry)[1, 1]
    if grid_mm > _ANOTHER_SIZE * max(panel_mm, *scan.grid.voxel_size_mm) or width_mm > _ANOTHER_SIZE * grid_mm:
        text += f", and the panel sees {panel_mm:.3g} mm"
        distances = "" if scan.is_parallel else ", distances"
        advice = f"compare pixel sizes{distances} and the grid, and their units, with the scanner's log"
        return Finding(_QUESTION, SUSPICIOUS, width_mm, grid_mm, "mm", text, advice)
    if level <= threshold:
        return Finding(_QUESTION, OK, level, threshold, "line integral", text)
    advice = (
        "the object reaches beyond the panel (or air is not 0: check the flats; a panel beside the axis needs a full turn). "
        "Expect a bright rim, unless the method "
        "reconstructs a box as large as the object: --roi-mm with --margin-mm, or fdk with --set extrapolate=reprojected"
    )
    return Finding(_QUESTION, SUSPICIOUS, level, threshold, CUT_OFF, text, advice)


def _width_mm(scan: Scan, p: np.ndarray, valid: np.ndarray, threshold: float) -> float:
    """Returns the object's width in mm at the axis, the median over frames. It has the columns in which over a tenth of the
    pixels are above ``threshold``."""
    geometry = scan.geometry
    columns = float(np.median((((p > threshold) & valid).mean(1) > _COVERED).sum(1)))
    if isinstance(geometry, ParallelGeometry):
        return columns * geometry.pixel_size_mm[1]
    half_fan_rad = math.atan2(columns * geometry.pixel_size_mm[1] / 2, geometry.source_to_detector_mm)
    return 2 * geometry.source_to_axis_mm * math.sin(half_fan_rad)


def _border(p: np.ndarray, valid: np.ndarray, columns: slice) -> float:
    """Returns the level of line integrals p (F, v, u) in ``columns``: the 90th percentile, over the frames, of the largest
    mean over an eighth of the rows."""
    edge = p[:, :, columns]
    weight = valid[:, :, columns].astype(float)
    rows = max(1, edge.shape[1] // 8)
    starts = np.arange(0, edge.shape[1], rows)
    total = np.add.reduceat((edge * weight).sum(2), starts, axis=1)
    count = np.add.reduceat(weight.sum(2), starts, axis=1)
    means = np.where(count > 0, total / np.maximum(count, 1), 0).max(1)
    return float(np.percentile(means, 100 * (1 - _FRAMES)))
