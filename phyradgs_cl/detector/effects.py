"""Effects of tube and panel on frames: photon and electronic noise, lag, gains, sparks, drift and scatter.

The simulator adds them; random ones come from a seeded generator. ``without_lag`` removes lag. Expected counts and their
random sample are separate functions: counts = Poisson(expected) + N(0, electronic_noise). Two rules give ``expected``:

- tigre: line integrals are first divided by the scan's largest one, so that the transmission lies in [1/e, 1]. The published
  synthetic scans have this noise (TIGRE's CTnoise; Biguri et al., Biomed. Phys. Eng. Express 2 055010, 2016).
- Beer-Lambert: expected = dose · exp(−p), as in a real panel.

Lag is one exponential from frame to frame: y_f = (1 − λ) x_f + λ y_(f−1), with y = 0 before the first frame, unless frames
say that the beam was on. Its effect on reconstructions is in Tilley et al., arXiv:1805.11631."""

import logging
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector.attenuation import TRANSMISSION_FLOOR
from phyradgs_cl.detector.noise_level import robust_deviation

_log = logging.getLogger(__name__)
Array = NDArray[np.floating]
# From this mean on, a rounded normal stands for Poisson (skewness off by < 4e-5): NumPy's own sampler fails near 9.2e18.
NORMAL_FROM = 1e9
COUNT_FLOOR = 0.5  # smaller counts, which no detector tells from 0, are raised to this, because 0 has no logarithm
_LARGEST_EXPONENT = 700.0  # largest exponent: float64 overflows at very negative line integrals, which ringing may cause
_SPARK_HEIGHT = (0.3, 2.0)  # least and most light that a spark adds, relative to the light without object
_SCATTER_REACH = 6.0  # (panel's longer side) / (length over which the scatter kernel falls to 1/e)
_SCATTER_POWERS = (0.8, 1.5)  # powers a, b of scattered light ∝ P^a p^b, with primary light P and line integral p
_FIRST = 6  # what was before the first frame is decided by this many frames
_NEAR = 2.0  # standard deviation in pixels of the blur that takes their noise
_SHADOW = 0.1  # pixels above this fraction of the largest line integral lie behind the object


def tigre_counts(line_integrals: ArrayLike, dose: float) -> tuple[Array, float]:
    """Returns expected counts dose · exp(−p/m) for p (F, v, u), and m: the largest p, or 1 if no p is above 0."""
    p = np.asarray(line_integrals, dtype=np.float64)
    largest = float(p.max(initial=0.0))
    scale = largest if largest > 0 else 1.0
    return beer_lambert_counts(p / scale, dose), scale


def beer_lambert_counts(line_integrals: ArrayLike, dose: float) -> Array:
    """Returns expected counts dose · exp(−p) for p (F, v, u)."""
    return np.exp(np.minimum(np.log(dose) - np.asarray(line_integrals, dtype=np.float64), _LARGEST_EXPONENT))


def sample_counts(expected: Array, electronic_noise: float, rng: np.random.Generator) -> Array:
    """Draws one sample of counts Poisson(``expected``) + N(0, ``electronic_noise``), (...) float64; it may be negative."""
    many = expected > NORMAL_FROM
    counts = rng.poisson(np.where(many, 0.0, expected)).astype(np.float64)
    if many.any():
        mean = expected[many]
        counts[many] = np.rint(mean + np.sqrt(mean) * rng.standard_normal(mean.shape))
    if electronic_noise > 0:
        counts += rng.normal(0.0, electronic_noise, counts.shape)
    return counts


def tigre_noise(
    line_integrals: ArrayLike, dose: float, electronic_noise: float, rng: np.random.Generator,
    light: ArrayLike = 1.0
) -> NDArray[np.float32]:
    """Returns noisy line integrals −ln(counts/dose) · m, (F, v, u) float32, after TIGRE's scaling. Negatives become 0.

    line_integrals (F, v, u): all projections of the scan, whose maximum is m. ``dose``: counts of an unattenuated pixel.
    ``electronic_noise``: standard deviation in counts. The published scans have a dose of 1e4 and an electronic noise of 10.
    ``light``: fraction of the dose for each pixel, above 0, broadcast to (F, v, u). It is below 1 where a pulse misses part
    of a line's window."""
    expected, scale = tigre_counts(line_integrals, dose)
    share = np.asarray(light, dtype=np.float64)
    p = _log_ratio(sample_counts(expected * share, electronic_noise, rng), dose * share) * scale
    return np.maximum(p, 0.0).astype(np.float32)


def beer_lambert_noise(
    line_integrals: ArrayLike, dose: float, electronic_noise: float, rng: np.random.Generator,
    light: ArrayLike = 1.0, lag: float = 0.0
) -> NDArray[np.float32]:
    """Returns −ln(counts/dose), (F, v, u) float32; ``COUNT_FLOOR`` is the least count. Negative values stay: with 0 in their
    place the mean of air would rise. A ``lag`` λ mixes successive frames, before electronic noise is added. Other arguments:
    as in ``tigre_noise``."""
    expected = beer_lambert_counts(line_integrals, dose)
    share = np.asarray(light, dtype=np.float64)
    counts = add_lag(sample_counts(expected * share, 0.0, rng), lag)
    if electronic_noise > 0:
        counts += rng.normal(0.0, electronic_noise, counts.shape)
    return _log_ratio(counts, dose * share).astype(np.float32)


def _log_ratio(counts: Array, dose: float | Array) -> Array:
    return np.log(dose) - np.log(np.maximum(counts, COUNT_FLOOR))


def add_lag(signal: ArrayLike, lag: float) -> NDArray[np.float64]:
    """Returns signals (F, ...), one per frame in order of time, as a panel with lag λ records them, float64:
    y_f = (1 − λ) x_f + λ y_(f−1), with y = 0 before the first frame."""
    return np.asarray(scipy.signal.lfilter([1 - lag], [1, -lag], np.asarray(signal, np.float64), axis=0))


def lagged(line_integrals: ArrayLike, lag: float) -> NDArray[np.float64]:
    """Returns line integrals (F, ...) as a panel with lag records them, without noise, float64."""
    return -np.log(add_lag(np.exp(-np.asarray(line_integrals, np.float64)), lag))


def without_lag(scan: Scan) -> Scan:
    """Returns the scan as a panel without lag would have recorded it. A scan whose lag is 0 is returned itself. The beam was
    off before the first frame, unless this frame would then be brighter than those that follow (``light_before``).

    Masked are transmissions at or below ``TRANSMISSION_FLOOR``, and values computed from a masked pixel of the same or the
    previous frame. Photon noise returns to its level without lag. Electronic noise grows by the factor √(1 + λ²)/(1 − λ)."""
    if scan.lag == 0:
        return scan
    projections = np.empty(scan.projections.shape, np.float32)
    bad = np.zeros(projections.shape, bool)
    previous, words = light_before(scan)
    if words:
        text = "lag %g: the first projection says that the beam was on before the scan: %s is taken as recorded before"
        _log.warning(text, scan.lag, words)
    for f, frame in enumerate(scan.projections):  # a float64 copy of the whole scan would be large
        recorded = np.exp(-frame.astype(np.float64))
        signal = (recorded - scan.lag * previous) / (1 - scan.lag)
        bad[f] = ~(signal > TRANSMISSION_FLOOR)
        projections[f] = -np.log(np.maximum(signal, TRANSMISSION_FLOOR))
        previous = recorded
    if scan.pixel_mask is None:
        return replace(scan, projections=projections, pixel_mask=bad if bad.any() else None, lag=0.0)
    masked = np.asarray(scan.pixel_mask) != 0
    if masked.ndim == 3:  # a masked pixel spoils the same pixel of the next frame too
        masked = masked | np.concatenate([masked[:1], masked[:-1]])
    return replace(scan, projections=projections, pixel_mask=masked | bad if bad.any() else masked, lag=0.0)


def light_before(scan: Scan) -> tuple[Array, str]:
    """Returns the transmissions (v, u) that a panel with lag recorded before the scan's first frame, and words for them: 0
    and "" if the beam was off.

    The second frame does not depend on them. Of a beam that was on the first one would come out brighter than that, by about
    1/(1 − λ) where it is bright, and no other frame would. Then the panel had recorded the same image, or air as in flats:
    whichever makes the first frame more like the second."""
    recorded = np.exp(-scan.projections[:_FIRST].astype(np.float64))
    off, usable = np.zeros(recorded.shape[1:]), scan.valid[:_FIRST].all(axis=0)
    if len(recorded) < 2 or not usable.any():
        return off, ""
    blurred = scipy.ndimage.gaussian_filter(recorded, (0, _NEAR, _NEAR))
    later = (blurred[1:] - scan.lag * blurred[:-1]) / (1 - scan.lag)
    bright = usable & (later[0] >= np.median(later[0][usable]))
    logs = np.log(np.maximum(later[:, bright], TRANSMISSION_FLOOR))

    def first(light: Array) -> Array:
        return (blurred[0] - scan.lag * light) / (1 - scan.lag)

    def excess(light: Array) -> Array:
        return np.log(np.maximum(first(light)[bright], TRANSMISSION_FLOOR)) - logs[0]

    without, gain = excess(off), -float(np.log1p(-scan.lag))
    usual = np.abs(np.median(np.diff(logs, axis=0), axis=1)).max(initial=0.0)
    if np.median(without) < max(gain / 2, usual) or robust_deviation(without) > gain:
        return off, ""
    kinds = {"the same image": (recorded[0], blurred[0]), "air": (off + 1, off + 1)}
    words = min(kinds, key=lambda kind: float(np.abs(first(kinds[kind][1]) - later[0])[usable].mean()))
    is_like = abs(np.median(excess(kinds[words][1]))) < np.median(without) / 2
    return (kinds[words][0], words) if is_like else (off, "")


def pixel_gains(shape: tuple[int, int], spread: float, rng: np.random.Generator) -> Array:
    """Draws gains (v, u) of pixels with mean 1 and standard deviation ``spread``, at least 0.05. A quarter of the variance
    is common to all pixels of a column."""
    own, column = rng.standard_normal(shape), rng.standard_normal((1, shape[1]))
    return np.maximum(1 + spread * (np.sqrt(0.75) * own + 0.5 * column), 0.05)


def add_sparks(line_integrals: Array, share: float, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
    """Returns line integrals (F, v, u) after light was added to pixels, each with the probability ``share``. Also returns
    which pixels were hit, bool (F, v, u)."""
    hit = rng.random(line_integrals.shape) < share
    height = rng.uniform(*_SPARK_HEIGHT, int(hit.sum()))
    sparked = np.array(line_integrals)
    sparked[hit] = -np.log(np.exp(-sparked[hit].astype(np.float64)) + height)
    return sparked, hit


def drifting_light(frames: int, largest: float, rng: np.random.Generator) -> Array:
    """Draws the tube's light in each frame (F,), relative to the flats: a random walk, at most ``largest`` away from 1."""
    walk = np.cumsum(rng.standard_normal(frames))
    walk -= walk.mean()
    return 1 + largest * walk / max(float(np.abs(walk).max()), 1e-12)


def add_scatter(line_integrals: Array, to_primary: float) -> Array:
    """Returns line integrals (F, v, u) with scatter, float64.

    A ray with the line integral p and the primary light P = exp(−p) scatters P^0.8 p^1.5, as Sun and Star-Lack (Phys. Med.
    Biol. 55 (2010) 6695) found for water. A kernel exp(−r/ℓ) spreads this light, where ℓ is a sixth of the panel's longer
    side. Behind the object, scatter is ``to_primary`` times the primary light on average."""
    p = np.asarray(line_integrals, np.float64)
    primary = np.exp(-p)
    lost = primary**_SCATTER_POWERS[0] * np.maximum(p, 0) ** _SCATTER_POWERS[1]
    scatter = np.stack([_spread(frame, max(p.shape[1:]) / _SCATTER_REACH) for frame in lost])
    shadow = p > _SHADOW * p.max()
    if not shadow.any() or scatter[shadow].sum() <= 0:
        return p
    return -np.log(primary + scatter * (to_primary * primary[shadow].sum() / scatter[shadow].sum()))


def _spread(light: Array, length: float) -> Array:
    """Convolves a frame (v, u) with exp(−r/length), where r and length are in pixels; beyond the panel the light is 0."""
    v, u = (np.arange(1 - n, n) for n in light.shape)
    kernel = np.exp(-np.hypot(v[:, None], u[None, :]) / length)
    return np.maximum(scipy.signal.fftconvolve(light, kernel / kernel.sum(), mode="same"), 0)
