"""The motion signal of a scan: from its frames, or as the scan or a file of comma-separated values states it. Also cubic
B-splines in time, for the weights of a displacement field that follows the signal.

From frames the signal is the first principal component of the Amsterdam shroud: the mean of each detector row in each frame.
Views from all sides show a displacement along the rotation axis in these means, while the gantry's turn changes them slowly.
L. Zijp et al., Extraction of the respiratory signal from sequential thorax cone-beam X-ray images, Proc. ICCR (2004) 507."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline
from scipy.signal import hilbert

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gating

_NODES = 4  # a field's weights are stored at this many times per interval between knots, and linear between these times
_STRETCH = 0.02  # weight of first differences in the bending energy: without it, a field could grow linearly in air
_HARMONICS = 6  # number of harmonics of the gantry's angle that are removed, because an object at rest causes them too
_FEWEST_CYCLES = 5  # a signal with fewer cycles in the scan counts as one without a period
_BAND = 0.25  # rates within this fraction of the dominant rate count as the same, since breaths differ in length
# A signal repeats if at least this fraction of its power lies about one rate (``_BAND``), beyond the part of white noise.
_PERIODIC_SHARE = 0.5
_FEWEST_FRAMES = 16  # a scan of fewer frames counts as one without a period
_FEWEST = 4  # a file must have at least this many values to be a signal
_KNOTS_PER_PERIOD = 6  # weights that follow a signal have this many knots per period
_SLOWER = 0.95  # without a period, knots follow a stated signal up to the frequency below which this share of its power lies
_MOST_EVEN = 100_000  # a signal is interpolated at evenly spaced times, with at most this many steps
_FORMS = f"at least {_FEWEST} lines: time in s, value; or one value for each frame"


@dataclass(frozen=True)
class TemporalSplines:
    """Uniform cubic B-splines in time, ``count`` of them, over ``intervals`` equal intervals from first_s to last_s."""

    first_s: float
    last_s: float
    intervals: int

    @classmethod
    def of_step(cls, first_s: float, last_s: float, step_s: float) -> "TemporalSplines":
        """Returns splines whose knots are at most ``step_s`` apart."""
        length_s = max(last_s - first_s, 1e-9)
        return cls(first_s, first_s + length_s, max(1, int(np.ceil(length_s / step_s))))

    @property
    def count(self) -> int:
        return self.intervals + 3

    @property
    def step_s(self) -> float:
        return (self.last_s - self.first_s) / self.intervals

    @property
    def node_times_s(self) -> np.ndarray:
        """Times at which weights are stored: four in each interval, and the end of the last."""
        return np.linspace(self.first_s, self.last_s, _NODES * self.intervals + 1)

    def at(self, times_s: np.ndarray) -> np.ndarray:
        """Returns the values (n, count) of all splines at times (n,) in s, constant before first_s and after last_s."""
        knots_s = self.first_s + self.step_s * np.arange(-3, self.intervals + 4)
        return BSpline(knots_s, np.eye(self.count), 3)(np.clip(times_s, self.first_s, self.last_s))

    def fit(self, times_s: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Returns coefficients (count, R) with which the splines follow R curves, ``values`` (n, R) at ``times_s`` (n,)."""
        nodes_s = self.node_times_s
        wanted = np.stack([np.interp(nodes_s, times_s, column) for column in values.T], -1)
        return np.asarray(np.linalg.lstsq(self.at(nodes_s), wanted, rcond=None)[0])

    def roughness(self) -> np.ndarray:
        """Returns the matrix K (count, count) that gives cᵀ K c, the sum of squared second differences of coefficients c."""
        return _difference_squares(self.count, 2)


class Bending:
    """Computes half the gradient of the bending energy Σ ‖∂²U/∂i∂j‖² + ``_STRETCH`` Σ ‖∂U/∂i‖² of control vectors U. Axes i
    and j are z, y, x. Derivatives are differences between neighbours.

    counts: numbers (cz, cy, cx) of control points."""

    def __init__(self, counts: tuple[int, ...]) -> None:
        self._first = [_difference_squares(n, 1) for n in counts]
        self._second = [_difference_squares(n, 2) for n in counts]

    def __call__(self, control: np.ndarray) -> np.ndarray:
        """Returns half the gradient, K U, for control vectors U (R, cz, cy, cx, 3); the energy is Uᵀ K U."""
        total = np.zeros_like(control)
        for axis in range(3):
            along = _apply(self._first[axis], control, axis)
            total += _apply(self._second[axis], control, axis) + _STRETCH * along
            for other in range(axis):
                total += 2 * _apply(self._first[other], along, other)
        return total


def _difference_squares(count: int, order: int) -> np.ndarray:
    """Returns DᵀD (count, count), where D takes the first or second (``order``) differences of ``count`` numbers."""
    differences = np.diff(np.eye(count), order, axis=0)
    return np.asarray(differences.T @ differences)


def _apply(matrix: np.ndarray, control: np.ndarray, axis: int) -> np.ndarray:
    return np.moveaxis(np.tensordot(matrix, control, (1, axis + 1)), 0, axis + 1)


@dataclass(frozen=True, eq=False)
class MotionSignal:
    """The course of the object's motion in time.

    - times_s (F,): the middles of the frames, rising. values (F,): mean 0, largest size 1, without a unit or a sign.
    - period_s: mean length of a cycle in s; None if no cycle repeats.
    - later (F,): the quadrature, a quarter of a cycle later; if None, ``pair`` derives it from ``values``.
    - knot_s: time in s between two spline knots of weights that follow the signal; None if weights need not follow it."""

    times_s: np.ndarray
    values: np.ndarray
    period_s: float | None = None
    later: np.ndarray | None = None
    knot_s: float | None = None

    def pair(self) -> np.ndarray:
        """Returns the signal and its quadrature, a quarter of a cycle later, (F, 2). Sums of both can follow hysteresis."""
        later = self.later
        if later is None:
            even_s, even = _evenly(self.times_s, self.values)
            later = np.interp(self.times_s, even_s, np.imag(hilbert(even)))
        return np.stack([self.values, scaled(later)], -1)


def motion_signal(scan: Scan) -> MotionSignal:
    """Returns the motion signal of a scan's frames. period_s and knot_s are None if ``period_of`` finds no period."""
    times_s = scan.middle_times_s
    order = np.argsort(times_s, kind="stable")
    times_s, rows = times_s[order], _shroud(scan)[order]
    explained = _gantry(scan, times_s, order)
    rest = rows - explained @ np.linalg.lstsq(explained, rows, rcond=None)[0]
    values = scaled(np.linalg.svd(rest, full_matrices=False)[0][:, 0])
    period_s = period_of(times_s, values)
    return MotionSignal(times_s, values, period_s, knot_s=None if period_s is None else period_s / _KNOTS_PER_PERIOD)


def period_of(times_s: np.ndarray, values: np.ndarray) -> float | None:
    """Returns the mean period in s of a signal (F,) at times (F,) in s. Returns None unless its power is concentrated about
    one rate of at least five cycles in the scan, and for fewer than 16 values."""
    power, length_s = _spectrum(times_s, values)
    last = len(power) - 1
    if len(values) < _FEWEST_FRAMES or last < _FEWEST_CYCLES or not power.sum() > 0:
        return None
    rates = np.arange(_FEWEST_CYCLES, last + 1)
    first_in, behind = np.ceil((1 - _BAND) * rates).astype(int), np.minimum((1 + _BAND) * rates, last).astype(int) + 1
    below = np.append(0.0, np.cumsum(power))
    width = (behind - first_in) / last
    share = ((below[behind] - below[first_in]) / power.sum() - width) / (1 - width)
    peak = int(np.argmax(share))
    if share[peak] < _PERIODIC_SHARE:
        return None
    band = np.arange(first_in[peak], behind[peak])
    return length_s * float(power[band].sum() / (power[band] @ band))


def _spectrum(times_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns the power of a signal (n,) at 0, 1, 2 … cycles in its time span, and the length of this span in s."""
    even_s, even = _evenly(times_s, values)
    power = np.abs(np.fft.rfft((even - even.mean()) * np.hanning(len(even)))) ** 2
    return power, float(even_s[-1] - even_s[0]) * len(even) / max(len(even) - 1, 1)


def _evenly(times_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns evenly spaced times, at the median step of ``times_s`` (n,), and ``values`` (n,) interpolated at them."""
    length_s = float(times_s[-1] - times_s[0])
    step_s = max(float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0, length_s / _MOST_EVEN)
    even_s = times_s[0] + step_s * np.arange(round(length_s / step_s) + 1 if step_s > 0 else 1)
    return even_s, np.interp(even_s, times_s, values)


def _shroud(scan: Scan) -> np.ndarray:
    """Returns the mean (F, rows) of every detector row over its valid pixels, the Amsterdam shroud."""
    valid = np.broadcast_to(scan.valid, scan.projections.shape)
    return np.asarray((scan.projections * valid).sum(2, dtype=np.float64) / np.maximum(valid.sum(2), 1))


def _gantry(scan: Scan, times_s: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Returns the n terms (F, n) that explain a row's mean for an object at rest: a constant, a line in time, harmonics of
    the gantry's angle. n is at most max(1, F/4). order (F,): frame numbers by time."""
    poses = np.stack([scan.trajectory.pose(int(f), np.array([t]))[0] for f, t in zip(order, times_s, strict=True)])
    towards = poses[:, :3] - (0.0 if scan.is_parallel else np.array(scan.grid.offset_mm[::-1]))
    angle_rad = np.arctan2(towards[:, 1], towards[:, 0])
    harmonics = [wave(k * angle_rad) for k in range(1, _HARMONICS + 1) for wave in (np.cos, np.sin)]
    drift = (times_s - times_s[0]) / max(times_s[-1] - times_s[0], 1e-300)
    most = max(1, len(times_s) // 4)  # more terms than this would explain few frames completely
    return np.stack([np.ones(len(times_s)), drift, *harmonics][:most], -1)


def scaled(values: np.ndarray) -> np.ndarray:
    """Returns a signal shifted and scaled to mean 0 and largest size 1; zeros stay zeros."""
    centred = values - values.mean()
    largest = np.abs(centred).max(initial=0.0)
    return np.asarray(centred / largest if largest > 0 else centred)


def load_gating(path: str, scan: Scan) -> Gating:
    """Loads a file with lines ``time in s, value``, or with one value for each frame of ``scan`` in their order. A heading
    may come first. Values with the heading ``phase`` are phases in cycles. Raises InputError for other files."""
    subject = f"gating {path}"
    try:
        # utf-8-sig: spreadsheets begin a file with a byte order mark
        lines = [line.strip() for line in Path(path).read_text(encoding="utf-8-sig").splitlines() if line.strip()]
        names, lines = (lines[0].lower(), lines[1:]) if lines and not _is_number(lines[0].split(",")[0]) else ("", lines)
        rows = [[float(word) for word in line.split(",")] for line in lines]
    except OSError as error:
        raise InputError(subject, str(error.strerror), _FORMS, "check the path") from error
    except ValueError as error:
        raise InputError(subject, str(error), _FORMS) from error
    if len(rows) < _FEWEST:
        raise InputError(subject, f"{len(rows)} lines of numbers", _FORMS)
    widths = {len(row) for row in rows}
    if widths not in ({1}, {2}):
        raise InputError(subject, "a line that is not two numbers", _FORMS)
    numbers = np.array(rows)
    if not np.isfinite(numbers).all():
        raise InputError(subject, f"{int((~np.isfinite(numbers)).any(1).sum())} lines with NaN or infinity", _FORMS)
    if widths == {1}:
        if len(rows) != scan.frames:
            raise InputError(subject, f"{len(rows)} values without times", f"one for each of {scan.frames} frames")
        numbers = np.column_stack([scan.middle_times_s, numbers])
    times_s, values = numbers[np.argsort(numbers[:, 0], kind="stable")].T
    try:
        return Gating(times_s, values, is_phase=names.split(",")[-1].strip() == "phase")
    except InputError as error:
        found = f"{len(times_s)} times from {times_s[0]:.4g} to {times_s[-1]:.4g} s, of which some are equal"
        raise InputError(subject, found, "times that rise") from error


def signal_of(gating: Gating, scan: Scan, subject: str) -> MotionSignal:
    """Returns the motion signal of the values or phases in ``gating``. Its period comes from the phases, or ``period_of``.

    Raises InputError, which names ``subject``, for times that do not cover the scan and for values that do not change."""
    times_s, values = gating.times_s, gating.values
    advance = float(gating.steps.sum()) if gating.is_phase else 0.0
    if advance == 0 and (gating.is_phase or np.ptp(values) == 0):
        remedy = "take --set gating=auto, which finds its own"
        raise InputError(subject, f"the same value {values[0]:.4g} throughout", "values that change", remedy)
    first_s, last_s = float(np.min(scan.frame_start_s)), float(np.max(scan.frame_start_s))
    if times_s[0] > first_s + scan.shutter.span_s or times_s[-1] < last_s:
        found = f"{len(times_s)} times from {times_s[0]:.4g} to {times_s[-1]:.4g} s"
        raise InputError(subject, found, f"times that cover the scan, {first_s:.4g} to {last_s:.4g} s")
    if gating.is_phase:
        angles_rad = 2 * np.pi * values
        cycle_s = float(times_s[-1] - times_s[0]) / advance
        return MotionSignal(times_s, scaled(np.cos(angles_rad)), cycle_s, np.sin(angles_rad), cycle_s / _KNOTS_PER_PERIOD)
    period_s = period_of(times_s, values)
    power, length_s = _spectrum(times_s, values)
    fastest = int(np.searchsorted(np.cumsum(power), _SLOWER * power.sum()))
    fastest_s = period_s or length_s / max(fastest, 1)
    return MotionSignal(times_s, scaled(values), period_s, knot_s=fastest_s / _KNOTS_PER_PERIOD)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
