"""Checks the detector: saturated areas, dead pixels, and drift of the gain over the scan."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from phyradgs_cl.acquisition import Saturation, Scan
from phyradgs_cl.acquisition.altered.angles import start_azimuths_rad
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding, outer_median
from phyradgs_cl.check.hypotheses import frame_number
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.detector.noise_level import clustered_share
from phyradgs_cl.prepare.bad_pixels import LEAST_FRAMES, axis_column, find_dead
from phyradgs_cl.reconstructors.fits.residuals import fit
from phyradgs_cl.runtime import Runtime

GAIN = "gain drift"
OVERFLOW = "overflow"  # a finding with this unit ends the check
_SATURATION, _DEAD = "saturation", "dead pixels"
_MOST_SATURATED = 1e-3  # a larger fraction of saturated pixels is suspicious
_REPEATS = 3  # a pixel counts as clipped at its least value if it has this value in at least this many frames
_ZERO = 1e-6  # smaller line integrals count as 0
_JUMP = 0.75  # a pixel jumps if (change of transmission to the next pixel) / (brightest transmission) exceeds this
_MOST_JUMPS = 5e-4  # a larger fraction of pixels that jump (``_JUMP``) is suspicious: counts have overflowed
_MOST_DEAD = 2e-4  # a larger fraction of dead pixels is suspicious
_LARGEST_DRIFT = 0.015  # a larger relative change of the gain over the scan is suspicious
_DRIFT_DEVIATIONS = 5.0  # a change of the gain counts only beyond this many of its standard deviations
_FEWEST_FRAMES = 8  # fewer frames cannot tell a drift from noise


@dataclass
class CountReader:
    """Converts counts to line integrals for ``read_scan``, as ``counts_to_attenuation`` does, and remembers saturation.

    ceiling: the largest count of projections, flats and invalid frames; None for files without counts. at_ceiling: the
    fraction of the projections' pixels in areas at that count."""

    ceiling: float | None = None
    at_ceiling: float = 0.0

    def __call__(
        self, data: np.ndarray, image_key: np.ndarray, quantity: str, at: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        if quantity == "counts":
            frames = data[image_key == 0]
            self.ceiling = float(data[(image_key == 0) | (image_key == 1)].max())
            self.at_ceiling = clustered_share(frames == self.ceiling)
        return counts_to_attenuation(data, image_key, quantity, at)


def check_saturation(scan: Scan, counts: CountReader | None = None) -> Finding:
    """Finds areas of pixels at one extreme value, suspicious above 0.1 % of the pixels. counts: the ``CountReader`` with
    which the scan's file was read; None if it was read otherwise.

    Only pixels whose neighbours have the same value count: saturation covers areas, noise clipped at 0 hits single pixels.
    Areas of exactly 0 may be air, so they get the answer "cannot tell"."""
    if counts is not None and counts.ceiling is not None and counts.at_ceiling > _MOST_SATURATED:
        return _clipped(Saturation(counts.ceiling, counts.at_ceiling), "lower the exposure, or mask these pixels")
    if scan.saturation is not None and scan.saturation.share > _MOST_SATURATED:
        return _clipped(scan.saturation, "lower the exposure; the import masked these pixels, or read them as air")
    p = np.asarray(scan.projections)
    masked = ~scan.valid
    jumps = _jumps(p, masked)
    if jumps > _MOST_JUMPS:
        text = f"{100 * jumps:.3g} % of neighbouring pixels jump from brightest to darkest"
        advice = "did counts overflow (65,536 becomes 0)? Read the frames as unsigned, or lower the exposure"
        return Finding(_SATURATION, SUSPICIOUS, jumps, _MOST_JUMPS, OVERFLOW, text, advice)
    lowest, highest = float(p[~masked].min()), float(p[~masked].max())
    is_inverted = outer_median(p, ~masked) == highest  # ``check_coverage`` reports inverted images
    at_least = clustered_share((p == lowest) & ~masked & (abs(lowest) > _ZERO))
    at_largest = 0.0
    if not is_inverted:
        at_least = max(at_least, _at_own_least(p, masked))
        at_largest = clustered_share((p == highest) & ~masked) if highest > _ZERO else 0.0
    name, share, value = ("largest", at_largest, highest) if at_largest > at_least else ("least", at_least, lowest)
    text = f"{100 * share:.3g} % of the pixels lie together at the {name} line integral, {value:.4g}"
    zeros = clustered_share((np.abs(p) < _ZERO) & ~masked)
    if share <= _MOST_SATURATED < zeros:
        text = f"{100 * zeros:.3g} % of the pixels lie together at 0: air without noise, or flats that are clipped too"
        return Finding(_SATURATION, CANNOT_TELL, zeros, _MOST_SATURATED, "share of pixels", text, "look at the raw counts")
    if share <= _MOST_SATURATED:
        return Finding(_SATURATION, OK, share, _MOST_SATURATED, "share of pixels", text)
    advice = "no light passes there: raise the exposure, or mask these pixels"
    if name == "least":
        advice = "the detector is saturated behind thin parts: lower the exposure, or mask these pixels"
    return Finding(_SATURATION, SUSPICIOUS, share, _MOST_SATURATED, "share of pixels", text, advice)


def _clipped(saturation: Saturation, remedy: str) -> Finding:
    share = saturation.share
    text = f"{100 * share:.3g} % of the pixels lie together at {saturation.level:g} counts"
    advice = f"the detector is saturated there: {remedy}"
    return Finding(_SATURATION, SUSPICIOUS, share, _MOST_SATURATED, "share of pixels", text, advice)


def _jumps(p: np.ndarray, masked: np.ndarray) -> float:
    """Returns the fraction of pixels whose transmission differs from that of the next pixel in the row by over 3/4 of the
    brightest transmission: the median over frames of line integrals p (F, v, u). Dead pixels are filtered out first."""
    if p.shape[2] < 2:
        return 0.0
    transmission = np.where(masked, 1.0, np.exp(-np.clip(p, -20, 20))).astype(np.float32)
    brightest = float(np.percentile(transmission[:: max(1, len(p) // 20)], 99))
    jumps = np.abs(np.diff(median_filter(transmission, size=(1, 1, 5)), axis=2)) > _JUMP * brightest
    return float(np.median(jumps.mean((1, 2))))  # the median ignores a few odd frames, which another question finds


def _at_own_least(p: np.ndarray, masked: np.ndarray) -> float:
    """Returns the ``clustered_share`` of line integrals p (F, v, u) at their pixel's least value, for pixels that have this
    value in three frames or more: their counts were clipped before the division by the flats.

    Pixels that never change do not count, because they are dead, nor line integrals of 0, which are noiseless air."""
    least = p.min(0)
    at = (p == least) & ~masked & (np.abs(least) > _ZERO) & (p.max(0) > least)
    return clustered_share(at & (at.sum(0) >= _REPEATS))


def check_dead_pixels(scan: Scan) -> tuple[Finding, np.ndarray]:
    """Finds dead pixels that are not masked yet. Returns the finding, and the map of dead pixels, bool (v, u).

    A dead pixel always has the same value, or differs from its neighbours in nearly every frame. More than 0.02 % of dead
    pixels are suspicious."""
    masked = ~scan.valid.any(0)
    if scan.frames < LEAST_FRAMES:
        text = f"fewer than {LEAST_FRAMES} frames"
        finding = Finding(_DEAD, CANNOT_TELL, 0.0, _MOST_DEAD, "share of pixels", text)
        return finding, np.zeros(masked.shape, bool)
    dead = find_dead(scan.projections, axis_column=axis_column(scan)) & ~masked
    count = int(dead.sum())
    share = count / max(int((~masked).sum()), 1)
    text = f"{count} dead pixels ({100 * share:.3g} %) are not masked"
    if share <= _MOST_DEAD:
        return Finding(_DEAD, OK, share, _MOST_DEAD, "share of pixels", text), dead
    row, column = (int(i[0]) for i in np.nonzero(dead))
    text += f", the first at row {row}, column {column}"
    advice = "'phyradgs prepare --steps dead' masks them"
    return Finding(_DEAD, SUSPICIOUS, share, _MOST_DEAD, "share of pixels", text, advice), dead


def check_gain(rt: Runtime, scan: Scan) -> Finding:
    """Finds drifts and jumps of the detector's gain, from the constants ("levels") that ``fit`` adds to the frames of a
    coarse ``scan``.

    A ramp over the scan, and a step at each inner frame, are fitted to the levels; the best of these fits counts. A change
    above both 1.5 % and five standard deviations is suspicious. Variation as sine and cosine of the angle is no drift."""
    if scan.frames < _FEWEST_FRAMES:
        return Finding(GAIN, CANNOT_TELL, 0.0, _LARGEST_DRIFT, "share", f"fewer than {_FEWEST_FRAMES} frames")
    level = fit(rt, scan).level
    angle, frames = start_azimuths_rad(scan), np.arange(scan.frames)
    turning = np.stack([np.ones(scan.frames), np.cos(angle), np.sin(angle)], 1)
    shapes = {"from the first frame to the last": np.linspace(-0.5, 0.5, scan.frames)}
    shapes |= {_step_place(scan, at): (frames >= at).astype(float) for at in range(3, scan.frames - 2)}
    fits = {where: _fit_change(turning, shape, level) for where, shape in shapes.items()}
    where, (change, deviation, _) = min(fits.items(), key=lambda item: item[1][2])
    change = math.expm1(-change)  # a larger gain gives smaller line integrals
    text = f"the gain changes by {100 * change:+.2f} ± {100 * deviation:.2f} % {where}"
    if abs(change) <= max(_LARGEST_DRIFT, _DRIFT_DEVIATIONS * deviation):
        verdict = OK if deviation * _DRIFT_DEVIATIONS < 3 * _LARGEST_DRIFT else CANNOT_TELL
        return Finding(GAIN, verdict, change, _LARGEST_DRIFT, "share", text, uncertainty=deviation)
    advice = "take flats before and after the scan, or normalise each frame by a patch of air"
    return Finding(GAIN, SUSPICIOUS, change, _LARGEST_DRIFT, "share", text, advice, deviation)


def _step_place(scan: Scan, at: int) -> str:
    """Returns in words where a step before the frame with index ``at`` is in the file, which may have more frames."""
    last, first = frame_number(scan, at - 1), frame_number(scan, at)
    return f"at frame {first} (from 0)" if first - last == 1 else f"between frames {last} and {first} (from 0)"


def _fit_change(turning: np.ndarray, shape: np.ndarray, level: np.ndarray) -> tuple[float, float, float]:
    """Fits ``level`` (F,) by least squares as a linear combination of ``shape`` (F,) and the columns of ``turning`` (F, n).

    Returns the coefficient of ``shape``, its standard deviation, and the squared residual."""
    design = np.column_stack([turning, shape])
    coefficients, *_ = np.linalg.lstsq(design, level, rcond=None)
    residual = level - design @ coefficients
    freedom = max(len(level) - design.shape[1], 1)
    squares = float(residual @ residual)
    deviation = math.sqrt(squares / freedom * float(np.linalg.pinv(design.T @ design)[-1, -1]))
    return float(coefficients[-1]), deviation, squares
