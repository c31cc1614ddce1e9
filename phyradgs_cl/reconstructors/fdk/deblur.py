"""Deblurring of a parallel fly-scan along the angle, before filtered backprojection.

In a parallel beam an exposure over an arc Δθ averages the sinogram along the angle with a box: every pixel of a detector row
sees p(θ, s) averaged over [θ − Δθ/2, θ + Δθ/2], whatever the object. Along the views this is a convolution, which a Wiener
filter inverts: with H(f) = sinc(f Δθ) it multiplies by (1 + λ) H / (H² + λ). λ is the power of noise over that of the
signal; without it noise would grow without bound at the zeros of H. Rows that open later see the same box at other angles.
A full turn is periodic, and behind half a turn the frames come back mirrored at the axis."""

import numpy as np
import scipy

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import exposure_arc_rad
from phyradgs_cl.errors import InputError

_UNEVEN = 0.02  # of a step between views
_REACH = 8  # boxes that views are continued beyond the ends of an arc
_FULL_TURN = 1.5  # steps: the largest gap of a full turn


def deblurred(scan: Scan, frames: np.ndarray, angle_rad: np.ndarray, noise: float) -> np.ndarray:
    """Returns frames (F, rows, columns) float32 as of a gantry that stops, at the angles (F,) of their middles.

    noise: λ above. Raises InputError for views whose angles are not evenly spaced, in whatever order."""
    arc_rad = exposure_arc_rad(scan)
    if arc_rad == 0:
        return frames
    order = np.argsort(np.mod(angle_rad, 2 * np.pi), kind="stable")
    turned = np.mod(angle_rad, 2 * np.pi)[order]
    gaps_rad = np.diff(turned, append=turned[0] + 2 * np.pi)
    start = (int(np.argmax(gaps_rad)) + 1) % len(order)
    step_rad = float(np.median(gaps_rad))
    is_full = gaps_rad.max() < _FULL_TURN * step_rad
    if np.abs(np.delete(gaps_rad, start - 1) / step_rad - 1).max(initial=0) > _UNEVEN:
        expected = "views at evenly spaced angles"
        raise InputError("option deblur", "views at uneven angles", expected, "leave it out, or take an iterative method")
    order = np.roll(order, -start)
    count = len(order)
    is_half = abs(count * step_rad - np.pi) < step_rad / 2
    pad = 0 if is_full or is_half else min(count - 1, int(np.ceil(_REACH * arc_rad / step_rad)))
    length = 2 * count if is_half else count + 2 * pad
    box = np.sinc(np.arange(length // 2 + 1) / length * arc_rad / step_rad)
    response = ((1 + noise) * box / (box**2 + noise)).astype(np.float32)
    result = np.empty_like(frames)
    for row in range(frames.shape[1]):
        line = frames[order, row]
        if is_half:
            line = np.concatenate([line, _mirrored(line, scan)])
        elif pad:
            line = np.pad(line, ((pad, pad), (0, 0)), mode="edge")
        spectrum = scipy.fft.rfft(line, axis=0, workers=-1) * response[:, None]
        result[order, row] = scipy.fft.irfft(spectrum, length, axis=0, workers=-1)[pad : pad + count]
    return result


def _mirrored(line: np.ndarray, scan: Scan) -> np.ndarray:
    """Returns views (F, columns) as from the other side: mirrored at the column of the axis, continued beyond the panel."""
    columns = line.shape[1]
    axis = (columns - 1) / 2 - scan.geometry.detector_offset_mm[1] / scan.geometry.pixel_size_mm[1]
    at = np.clip(2 * axis - np.arange(columns), 0, columns - 1)
    low = np.minimum(at.astype(int), max(columns - 2, 0))
    share = (at - low).astype(np.float32)
    return line[:, low] * (1 - share) + line[:, np.minimum(low + 1, columns - 1)] * share
