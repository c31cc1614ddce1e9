"""Finds pixels to mask: sparks, which hit single pixels of single frames, and dead or hot pixels and lines.

Sparks (zingers) come from X-rays, cosmic rays or noise. A feature that is sharper in every direction than the optics can
make it is no part of the object (van Dokkum, Publ. Astron. Soc. Pac. 113 (2001) 1420, for cosmic rays on telescopes). Dead
pixels never change, or differ from their neighbours in nearly every frame."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector.noise_level import NORMAL_MAD, robust_deviation
from phyradgs_cl.prepare.step import Facts, MakeModel, StepOptions, unmasked_frames, with_masked

_AROUND = np.ones((3, 3), bool)
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)
_SHARPNESS = 0.3  # a spark is brighter than the pixels on both sides, in every direction, by this fraction of its height
_NEAR, _FAR = 2, 3  # a spark's surroundings are 2 pixels away, or 3 where another spark is near
_MOVED = 5  # the next frame may show a gap of the object moved by up to 2 pixels, so a square of this side is searched
_SHOWN_AGAIN = 0.5  # a gap of the object is at least this fraction as high in the frames before and after; a spark is not
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
LEAST_FRAMES = 5  # in fewer frames a sound pixel may look dead by chance
_DEVIATIONS = 10.0
_MOST_TIMES = 0.7  # a dead pixel is above, or below, all its neighbours in more than this fraction of the frames
_MOST_FRAMES = 40  # dead pixels are sought in at most this many frames, evenly spread, to save time
_STILL_SIDES = 0.5  # if more than this fraction of the two outermost columns never changes, they are air without noise
_NEAR_AXIS = 1.5  # a small part of the object this close to the axis, in columns, stays on one pixel in all views
_SHARED = 0.1  # a dead pixel differs alone: its neighbours differ by less than this fraction of its difference
_MIRRORED = 0.15  # the mirror image of an object's column about the axis is at least this fraction as high
_BESIDE = 3  # a needle that sways a little changes the columns beside it: the usual change is that of columns this far away
_UNLIKE = 4.0  # a column whose standard deviation over frames is this many times smaller or larger varies otherwise
_LINE = 0.9  # a row or column with more than this fraction of dead pixels is dead as a whole


@dataclass(frozen=True)
class SparkOptions(StepOptions, step="sparks"):
    """Options of the step ``sparks``. threshold: least height of a spark in local standard deviations (``find_sparks``).
    least: least height in line integrals, dimensionless. pixels: most touching pixels that count as one spark."""

    threshold: float = checks.ranged(5.0, 1, 1e3)
    least: float = checks.ranged(0.1, 0, 10)
    pixels: int = checks.ranged(6, 1, 100)


@dataclass(frozen=True)
class DeadOptions(StepOptions, step="dead"):
    """Options of the step ``dead``. deviations: least difference of a dead pixel from its neighbours, in robust standard
    deviations of this difference over the panel."""

    deviations: float = checks.ranged(_DEVIATIONS, 1, 1e3)


def mask_sparks(scan: Scan, options: SparkOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """Returns the scan with its sparks masked and interpolated."""
    sparks = find_sparks(unmasked_frames(scan), **vars(options)) & scan.valid
    count = int(sparks.sum())
    return with_masked(scan, sparks), {"pixels": count, "share": count / sparks.size}


def find_sparks(
    frames: np.ndarray, *, threshold: float = 5.0, least: float = 0.1, pixels: int = 6
) -> np.ndarray:
    """Returns the pixels, bool (F, v, u), of line integrals (F, v, u) that are brighter than an object can make them.

    A spark's line integral lies below the median of 5 × 5 pixels by ``least``, and by ``threshold`` standard deviations.
    These are estimated from the median distance to that median in 9 × 9 pixels. A spark is sharp in every direction and has
    at most ``pixels`` touching pixels. A feature that the frames before and after (at an end the one neighbour) show nearby,
    at least half as high, is a gap of the moving object and no spark."""
    sparks = np.stack([_sparks_of(frame, threshold, least, pixels) for frame in frames])
    for f in np.flatnonzero(sparks.any(axis=(1, 2))) if len(frames) > 2 else ():
        height = _height(frames[f])
        neighbours = (frames[f - 1 if f else 1], frames[f + 1 if f + 1 < len(frames) else f - 1])
        shown = [scipy.ndimage.maximum_filter(_height(frame), size=_MOVED) for frame in neighbours]
        sparks[f] &= np.minimum(*shown) < _SHOWN_AGAIN * height
    return sparks


def _sparks_of(frame: np.ndarray, threshold: float, least: float, pixels: int) -> np.ndarray:
    height = _height(frame)
    bright = height > least
    if not bright.any():
        return bright
    usual = scipy.ndimage.median_filter(np.abs(height), size=9, mode="nearest")
    bright &= height > threshold * NORMAL_MAD * usual
    for sides in _opposite(frame):
        bright &= sides - frame > _SHARPNESS * height
    groups, count = scipy.ndimage.label(bright, _AROUND)
    return bright & (np.bincount(groups.ravel(), minlength=count + 1)[groups] <= pixels)


def _height(frame: np.ndarray) -> np.ndarray:
    """Returns how far each pixel of line integrals (v, u) lies below the median of 5 × 5 pixels: the height of a spark."""
    return np.asarray(scipy.ndimage.median_filter(frame, size=5, mode="nearest") - frame)


def _opposite(frame: np.ndarray) -> Iterable[np.ndarray]:
    """Yields, for each of four directions, the lower value (v, u) of the two opposite pixels 2 pixels away. If the lower
    value of those 3 pixels away is higher, yields that, because a nearer pixel may be a spark too. The frame is mirrored at
    the panel's edge."""
    wide = np.pad(frame, _FAR, mode="symmetric")
    rows, columns = frame.shape

    def moved(v: int, u: int) -> np.ndarray:
        return wide[_FAR + v : _FAR + v + rows, _FAR + u : _FAR + u + columns]

    for v, u in _DIRECTIONS:
        pairs = (np.minimum(moved(k * v, k * u), moved(-k * v, -k * u)) for k in (_NEAR, _FAR))
        yield np.maximum(*pairs)


def mask_dead(scan: Scan, options: DeadOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """Returns the scan with its dead pixels and lines masked and interpolated."""
    column = axis_column(scan)
    dead = find_dead(scan.projections, deviations=options.deviations, axis_column=column) & scan.valid.any(0)
    rows, columns = (int(np.count_nonzero(dead.all(axis=axis))) for axis in (1, 0))
    return with_masked(scan, dead), {"pixels": int(dead.sum()), "rows": rows, "columns": columns}


def axis_column(scan: Scan) -> float:
    """Returns the column onto which the first frame projects the axis of rotation, as a fractional index."""
    time_s = scan.frame_start_s[:1] + scan.shutter.middle_s
    source, corner, u, v = scan.trajectory.pose(0, time_s)[0].reshape(4, 3)
    return float(np.linalg.lstsq(np.stack([u, v, source], axis=1), source - corner, rcond=None)[0][0])


def find_dead(
    frames: np.ndarray, *, deviations: float = _DEVIATIONS, axis_column: float | None = None
) -> np.ndarray:
    """Returns the dead pixels, bool (v, u), of line integrals (F, v, u); none for fewer than five frames.

    A pixel is dead if it never changes while its neighbours do. It is also dead if it is above all its neighbours, or below
    all, in more than 70 % of the frames. It must then differ from the median of 3 × 3 pixels by more than ``deviations``
    standard deviations of this difference over the panel. Near ``axis_column`` small parts of the object stay on one pixel:
    there a dead pixel must also be sharper than the optics. A whole row or column is dead if it lies above or below both
    neighbours over more than 90 % of its length. A column whose mirror image about the axis does so too may be a needle on
    the axis or the wall of a tube: it is dead only if it varies otherwise than the columns around. At most 40 frames, evenly
    spread, are examined."""
    if len(frames) < LEAST_FRAMES:
        return np.zeros(frames.shape[1:], bool)
    numbers = np.unique(np.linspace(0, len(frames) - 1, _MOST_FRAMES).round().astype(int))
    some = np.asarray(frames)[numbers]
    still = np.zeros(frames.shape[2], bool)
    if axis_column is not None:
        still = np.abs(np.arange(frames.shape[2]) - axis_column) <= _NEAR_AXIS
    pixels = _constant(some) | (_exceeding(some, deviations) & ~(_shared(some) & still))
    return pixels | _lines(some, deviations, axis_column)


def _lines(frames: np.ndarray, deviations: float, axis_column: float | None) -> np.ndarray:
    """Returns whole rows and columns, bool (v, u), that lie above or below both neighbours in over 90 % of their pixels, in
    the median over frames, and are none of an object's about the axis. Pixels of air count too."""
    dead = np.zeros(frames.shape[1:], bool)
    floor = 1e-3 * max(float(np.percentile(frames, 99.9)), 1e-9)
    for axis in (0, 1):
        lines = np.moveaxis(frames, axis + 1, 0)
        if len(lines) < 3:
            continue
        steps = np.diff(lines, axis=0)
        usual = NORMAL_MAD * float(np.median(np.abs(np.median(steps, axis=1))))
        before, after = steps[:-1], -steps[1:]
        peak = np.where(before * after > 0, np.sign(before) * np.minimum(np.abs(before), np.abs(after)), 0)
        exceeds = np.abs(np.median(peak, axis=1)) > deviations * max(usual, floor)
        np.moveaxis(dead, axis, 0)[1 + np.flatnonzero(exceeds.mean(axis=1) > _LINE)] = True
        if axis == 1 and axis_column is not None and dead.any():
            dead &= ~(dead.all(axis=0) & _about_axis(frames, axis_column, floor))
    return dead


def _about_axis(frames: np.ndarray, axis_column: float, least: float) -> np.ndarray:
    """Returns the columns, bool (u,), that may be an object's about the axis: mirror images stand out too, and they vary as
    columns around, up to ``least``. frames: (F, v, u)."""
    usual = np.median(frames, axis=0)
    height = np.median(usual - scipy.ndimage.median_filter(usual, (1, 5), mode="nearest"), axis=0)
    columns, varies = np.arange(len(height)), frames.std(axis=0).mean(axis=0) + least
    at = np.round(2 * axis_column - columns) + np.array([[-1], [0], [1]])
    images = np.interp(at, columns, height, left=0, right=0)
    around = np.interp(columns + np.array([[-_BESIDE], [_BESIDE]]), columns, varies)
    is_mirrored = np.max(images * np.sign(height), axis=0) > _MIRRORED * np.abs(height)
    noisier = np.exp(np.maximum(height, 0) / 2)  # fewer photons come through
    is_calm = varies < np.min(around, axis=0) / _UNLIKE
    return np.asarray(is_mirrored & ~is_calm & (varies < _UNLIKE * noisier * np.max(around, axis=0)))


def _constant(frames: np.ndarray) -> np.ndarray:
    """Returns the pixels, bool (v, u), that never change while their neighbours do. Air without noise does not count."""
    swing = np.ptp(frames, axis=0)
    constant = swing == 0
    sides = np.zeros_like(constant)
    sides[:, [0, -1]] = constant[:, [0, -1]]
    if sides[:, [0, -1]].mean() > _STILL_SIDES:
        level, pattern = float(np.median(frames[0][sides])), robust_deviation(frames[0][sides])
        air = constant & (np.abs(frames[0] - level) <= _DEVIATIONS * pattern)
        constant = constant & ~scipy.ndimage.binary_propagation(sides, _AROUND, mask=air)
    return constant & (scipy.ndimage.median_filter(swing, size=3) > 0)


def _exceeding(frames: np.ndarray, deviations: float) -> np.ndarray:
    """Returns the pixels, bool (v, u), far above or far below all neighbours in most frames. Pixels at an object's edge are
    not among them, because the edge moves, or covers several pixels in a line."""
    above = np.mean([f > scipy.ndimage.maximum_filter(f, footprint=_NEIGHBOURS) for f in frames], axis=0)
    below = np.mean([f < scipy.ndimage.minimum_filter(f, footprint=_NEIGHBOURS) for f in frames], axis=0)
    difference = np.median([f - scipy.ndimage.median_filter(f, size=3) for f in frames], axis=0)
    floor = 1e-3 * float(np.percentile(frames, 99.9))
    least = deviations * max(robust_deviation(difference), floor, 1e-12)
    return (np.abs(difference - np.median(difference)) > least) & (np.maximum(above, below) > _MOST_TIMES)


def _shared(frames: np.ndarray) -> np.ndarray:
    """Returns the pixels, bool (v, u), whose four neighbours differ from the median of 5 × 5 in the same direction, as in a
    blurred image of an object. The median of the neighbours' four differences counts, since one may be dead too."""
    difference = np.median([f - scipy.ndimage.median_filter(f, size=5) for f in frames], axis=0)
    wide = np.pad(difference, 1, mode="edge")
    sides = np.median([wide[:-2, 1:-1], wide[2:, 1:-1], wide[1:-1, :-2], wide[1:-1, 2:]], axis=0)
    return sides * np.sign(difference) > _SHARED * np.abs(difference)
