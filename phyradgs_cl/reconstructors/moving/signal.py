"""The motion signal of a scan, from its frames: the first principal component of the Amsterdam shroud.

The shroud has the mean of every detector row of every frame. A displacement along the rotation axis shows in it from all
sides, while the gantry's own turning changes it slowly. L. Zijp et al., Extraction of the respiratory signal from sequential
thorax cone-beam X-ray images, Proc. ICCR (2004) 507."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import hilbert

from phyradgs_cl.acquisition import Scan

_HARMONICS = 6  # of the gantry's angle, which the object at rest explains
_FEWEST_CYCLES = 5  # in the scan: slower motion is taken as free in time
_BAND = 0.25  # on either side of the most frequent rate: breaths differ in length
_PERIODIC_SHARE = 0.5  # of the power in that band, beyond what white noise has there
_FEWEST_FRAMES = 16


@dataclass(frozen=True, eq=False)
class MotionSignal:
    """How the object's motion goes on in time. times_s (F,): the middles of the frames, rising. values (F,): mean 0, largest
    size 1, without a unit or a sign. period_s: mean length of a cycle, or None where no cycle repeats. later (F,): the
    quadrature, a quarter of a cycle later; None derives it from ``values``."""

    times_s: np.ndarray
    values: np.ndarray
    period_s: float | None = None
    later: np.ndarray | None = None

    def pair(self) -> np.ndarray:
        """Returns the signal and its quadrature (F, 2), a quarter of a cycle later; both together follow hysteresis."""
        later = np.imag(hilbert(self.values)) if self.later is None else self.later
        return np.stack([self.values, scaled(later)], -1)


def motion_signal(scan: Scan) -> MotionSignal:
    """Returns the signal of a scan's frames. Its period is None where no rate dominates, or with less than 16 frames."""
    times_s = middle_times_s(scan)
    order = np.argsort(times_s, kind="stable")
    times_s, rows = times_s[order], _shroud(scan)[order]
    explained = _gantry(scan, times_s, order)
    rest = rows - explained @ np.linalg.lstsq(explained, rows, rcond=None)[0]
    values = scaled(np.linalg.svd(rest, full_matrices=False)[0][:, 0])
    return MotionSignal(times_s, values, period_of(times_s, values))


def middle_times_s(scan: Scan) -> np.ndarray:
    """Returns the middles (F,) of the times at which a frame's lines are open."""
    return np.asarray(scan.frame_start_s, np.float64) + scan.shutter.span_s / 2


def period_of(times_s: np.ndarray, values: np.ndarray) -> float | None:
    """Returns the mean period of a signal (F,), or None where its power is not concentrated at one rate."""
    count, step_s = len(values), float(np.median(np.diff(times_s))) if len(values) > 1 else 0.0
    if count < _FEWEST_FRAMES or step_s <= 0:
        return None
    even_s = times_s[0] + step_s * np.arange(int(round((times_s[-1] - times_s[0]) / step_s)) + 1)
    even = np.interp(even_s, times_s, values)
    power = np.abs(np.fft.rfft((even - even.mean()) * np.hanning(len(even)))) ** 2
    rates = np.arange(len(power))  # cycles in the scan
    if len(power) <= _FEWEST_CYCLES or not power.sum() > 0:
        return None
    in_band = np.abs(rates[:, None] / np.maximum(rates, 1) - 1) <= _BAND
    width = in_band[1:].mean(0)
    share = (power @ in_band / power.sum() - width) / (1 - width)
    peak = _FEWEST_CYCLES + int(np.argmax(share[_FEWEST_CYCLES:]))
    if share[peak] < _PERIODIC_SHARE:
        return None
    mean_rate = float(power @ (in_band[:, peak] * rates) / (power @ in_band[:, peak]))
    return len(even) * step_s / mean_rate


def _shroud(scan: Scan) -> np.ndarray:
    """Returns the mean of the valid pixels (F, rows) of every detector row."""
    valid = np.broadcast_to(scan.valid, scan.projections.shape)
    count = np.maximum(valid.sum(2), 1)
    return np.asarray((scan.projections * valid).sum(2, dtype=np.float64) / count)


def _gantry(scan: Scan, times_s: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Returns what an object at rest, or a slow drift, puts into a row (F, n): harmonics of the angle, and a line."""
    poses = np.stack([scan.trajectory.pose(int(f), np.array([t]))[0] for f, t in zip(order, times_s, strict=True)])
    towards = poses[:, :3] - (0.0 if scan.is_parallel else np.array(scan.grid.offset_mm[::-1]))
    angle_rad = np.arctan2(towards[:, 1], towards[:, 0])
    harmonics = [wave(k * angle_rad) for k in range(1, _HARMONICS + 1) for wave in (np.cos, np.sin)]
    drift = (times_s - times_s[0]) / max(times_s[-1] - times_s[0], 1e-300)
    most = max(1, len(times_s) // 4)  # of few frames they would explain everything
    return np.stack([np.ones(len(times_s)), drift, *harmonics][:most], -1)


def scaled(values: np.ndarray) -> np.ndarray:
    """Returns a signal of mean 0 and largest size 1; zeros stay zeros."""
    centred = values - values.mean()
    largest = np.abs(centred).max(initial=0.0)
    return np.asarray(centred / largest if largest > 0 else centred)
