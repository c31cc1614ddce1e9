"""Finds frames that do not belong to the scan: black or bright ones, repeated ones, and ones that do not fit the others."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import start_azimuths_rad, wrapped
from phyradgs_cl.acquisition.altered.coarse import some_frames
from phyradgs_cl.check.hypotheses import frame_number
from phyradgs_cl.detector import robust_deviation
from phyradgs_cl.reconstructors.fits.residuals import Fit, fit, fit_squares
from phyradgs_cl.runtime import Runtime

# A frame is odd where its mean line integral differs from its neighbours' by more than both of these.
_DEVIATIONS = 12.0  # difference in robust standard deviations of all frames' differences
_LEAST_CHANGE = 0.75  # difference as a fraction of the frames' median mean line integral
_FEWEST = 5  # scans of fewer frames are not judged
_REPEATED = 0.15  # a repeated frame differs from its predecessor by less than this fraction of the neighbouring differences
_JUMP = 2.5  # the order of angles jumps above this ratio of the median steps in recorded and in sorted order
_UNLIKE = 2.0  # a repeated frame differs from the next view in angle by more than this many times the median difference
_OUTLIER = 4.0  # an outlier's residual is at least this many times the frames' median
# An arc's first and last frame fit about equally badly where their residuals differ by less than this factor: right frames
# had at most 1.4, one odd frame at least 2.3.
_ALIKE = 1.7
# Such a first or last frame is kept only with a residual below this fraction of that in a random order: right frames had
# 0.2, odd ones mostly 0.3.
_AT_BOTH_ENDS = 0.25
_MOST_OUTLIERS = 0.2  # from this fraction of the frames on, the cause is common to all, and no frame counts as an outlier
_EXCHANGED = 0.5  # two frames were exchanged where the opposite order leaves less than this fraction of the squared residual


def without_odd_frames(scan: Scan) -> tuple[np.ndarray, list[str]]:
    """Finds odd and repeated frames before any reconstruction. Returns the indices (n,) of the other frames, and a note
    for each one left out."""
    odd, repeated = odd_frames(scan.projections, scan.pixel_mask), repeated_frames(scan)
    notes = [f"frame {frame_number(scan, f)} is unlike all others (black, bright, or no image)" for f in odd]
    notes += [f"frame {frame_number(scan, f)} is frame {frame_number(scan, f - 1)} recorded twice" for f in repeated]
    return np.setdiff1d(np.arange(scan.frames), [*odd, *repeated]), notes


def odd_frames(p: np.ndarray, mask: np.ndarray | None) -> list[int]:
    """Returns the indices of frames of p (F, v, u) whose mean line integral is far from their neighbours'."""
    if len(p) < _FEWEST:
        return []
    valid = 1.0 if mask is None else (np.asarray(mask) == 0).astype(np.float32)
    weight = np.broadcast_to(valid, p.shape)
    level = (p * weight).sum((1, 2), dtype=np.float64) / np.maximum(weight.sum((1, 2)), 1)
    difference = level - np.median(_neighbours(level), axis=0)
    least = max(_DEVIATIONS * robust_deviation(difference), _LEAST_CHANGE * abs(float(np.median(level))))
    return [int(f) for f in np.flatnonzero(np.abs(difference) > least)]


def repeated_frames(scan: Scan) -> list[int]:
    """Returns the indices of frames that repeat their predecessor although the gantry has turned: the two differ far less
    than neighbours do. In an order that jumps, such as the golden angle, they must also be unlike the next view in angle,
    because distant views of a round object may look the same."""
    p = scan.projections
    if len(p) < _FEWEST:
        return []
    valid = np.broadcast_to(True if scan.pixel_mask is None else np.asarray(scan.pixel_mask) == 0, p.shape)
    pairs = zip(p[:-1], p[1:], valid[:-1] & valid[1:], strict=True)
    steps = np.array([_rms((b - a)[seen]) if seen.any() else np.inf for a, b, seen in pairs])
    azimuths_rad = start_azimuths_rad(scan)
    turned_rad = np.abs(wrapped(np.diff(azimuths_rad)))
    alike = np.flatnonzero((turned_rad > 1e-6) & (steps < _REPEATED * np.min(_neighbours(steps), axis=0)))
    order = np.argsort(azimuths_rad % (2 * np.pi))
    beside = np.empty(len(p), int)
    beside[order] = np.roll(order, -1)
    jumps = np.median(turned_rad) > _JUMP * np.median(np.abs(wrapped(azimuths_rad[beside] - azimuths_rad)))
    if alike.size and jumps:
        from_beside = np.array([_rms(p[g] - frame) for frame, g in zip(p, beside, strict=True)])
        alike = alike[from_beside[alike + 1] > _UNLIKE * np.median(from_beside)]
    return [int(f) + 1 for f in alike]


def _rms(image: np.ndarray) -> float:
    return float(np.square(image, dtype=np.float64).mean()) ** 0.5


def _neighbours(values: np.ndarray) -> np.ndarray:
    """Returns, as (4, F), the two values before and the two after each of ``values`` (F,), mirrored at the ends."""
    wide = np.r_[values[2:0:-1], values, values[-2:-4:-1]]
    return np.stack([wide[:-4], wide[1:-3], wide[3:-1], wide[4:]])


def without_outliers(
    rt: Runtime, scan: Scan, stated: Fit, random_square: float
) -> tuple[np.ndarray, Fit, list[str]]:
    """Removes frames whose residual is far above the others', the worst first, with a new fit after each.

    stated: the fit of all frames. random_square: the mean squared residual of frames in a random order. Returns the
    indices (n,) of the other frames, their fit, and notes. Where a fifth of the frames would go, all frames have the same
    cause, and none is removed. Two outliers may be frames whose order is exchanged."""
    remaining, current = np.arange(scan.frames), stated
    outliers: list[int] = []
    while len(outliers) < _MOST_OUTLIERS * scan.frames:
        size = np.sqrt(current.squares)
        size[_ends_alike(size, random_square**0.5)] = 0
        worst = int(np.argmax(size))
        if size[worst] < _OUTLIER * np.sqrt(np.median(current.squares)):
            break
        outliers.append(int(remaining[worst]))
        remaining = np.delete(remaining, worst)
        current = fit(rt, some_frames(scan, remaining))
    if not outliers or len(outliers) >= _MOST_OUTLIERS * scan.frames:
        return np.arange(scan.frames), stated, []
    numbers = sorted(frame_number(scan, f) for f in outliers)
    frames, do = ("frames", "do") if len(outliers) > 1 else ("frame", "does")
    note = f"{frames} {', '.join(map(str, numbers))} (from 0) {do} not fit the others"
    if len(outliers) == 2:
        order = np.arange(scan.frames)
        order[outliers] = order[outliers[::-1]]
        if fit_squares(rt, replace(scan, projections=scan.projections[order])).sum() < _EXCHANGED * stated.total:
            note = f"frames {numbers[0]} and {numbers[1]} (from 0) fit if their order is exchanged"
    return remaining, current, [note]


def _ends_alike(residual: np.ndarray, random: float) -> np.ndarray:
    """Returns which first and last frames, bool (F,), fit about equally badly, as correct frames of an open arc do.

    Frames at an end have neighbours on one side only, so a fit of few iterations leaves larger residuals, and a slow
    drift shows in them. If they were removed, the frames next to them would follow. random: the residual in a random
    order."""
    is_apart = residual >= _OUTLIER * np.median(residual)
    at_an_end = np.logical_and.accumulate(is_apart) | np.logical_and.accumulate(is_apart[::-1])[::-1]
    return at_an_end & (residual < _ALIKE * residual[::-1]) & (residual < _AT_BOTH_ENDS * random)
