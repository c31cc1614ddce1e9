"""Photon and electronic noise: what is expected, and one sample of it, are separate functions.

counts = Poisson(expected) + N(0, electronic_noise), in two ways of arriving at `expected`:

- tigre: line integrals over the scan's largest one, which squeezes the transmission into [1/e, 1]: the noise of the
  published synthetic scans (TIGRE's CTnoise; Biguri et al., Biomed. Phys. Eng. Express 2 055010, 2016).
- beer-lambert: expected = dose · exp(-p), the physics.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import at_least, finite, positive
from phyradgs_cl.detector.lag import add_lag

Array = NDArray[np.float64]

# Above this mean Poisson is drawn as a rounded normal: NumPy's sampler fails near 9.2e18, and the
# skewness that is lost is below 4e-5.
NORMAL_FROM = 1e9
# Counts are kept at or above this before the logarithm: half a count, less than a detector can tell.
COUNT_FLOOR = 0.5


def tigre_counts(line_integrals: ArrayLike, dose: float) -> tuple[Array, float]:
    """Expected counts dose · exp(-p/m) of p (F, v, u), and the scale m: its largest value, of an empty scan 1."""
    p = np.asarray(line_integrals, dtype=np.float64)
    largest = float(p.max(initial=0.0))
    scale = largest if largest > 0 else 1.0
    return _attenuated(p / scale, dose), scale


def beer_lambert_counts(line_integrals: ArrayLike, dose: float) -> Array:
    """Expected counts dose · exp(-p); line_integrals (F, v, u), dose in counts."""
    return _attenuated(np.asarray(line_integrals, dtype=np.float64), dose)


def sample_counts(expected: Array, electronic_noise: float, rng: np.random.Generator) -> Array:
    """One draw of Poisson(expected (...)) + N(0, electronic_noise), float64 counts, not clamped."""
    many = expected > NORMAL_FROM
    counts = rng.poisson(np.where(many, 0.0, expected)).astype(np.float64)
    if many.any():
        mean = expected[many]
        counts[many] = np.rint(mean + np.sqrt(mean) * rng.standard_normal(mean.shape))
    if electronic_noise > 0:
        counts += rng.normal(0.0, electronic_noise, counts.shape)
    return counts


def tigre_noise(
    line_integrals: ArrayLike,
    dose: float,
    electronic_noise: float,
    rng: np.random.Generator,
    light: ArrayLike = 1.0,
) -> NDArray[np.float32]:
    """Noisy line integrals -ln(counts/dose) · m, (F, v, u) float32, after TIGRE's scaling; negatives become 0.

    line_integrals (F, v, u): all projections of the scan, m is their maximum. ``dose``: counts of an unattenuated pixel;
    ``electronic_noise``: standard deviation in counts; the published scans have 1e4 and 10. ``light``: share of the dose of
    each pixel, above 0, broadcast to (F, v, u): a pulse may miss part of a line's window. InputError: dose not positive,
    electronic noise negative, line integrals not finite.
    """
    _check(line_integrals, dose, electronic_noise)
    expected, scale = tigre_counts(line_integrals, dose)
    share = np.asarray(light, dtype=np.float64)
    p = _log_ratio(sample_counts(expected * share, electronic_noise, rng), dose * share) * scale
    return np.maximum(p, 0.0).astype(np.float32)


def beer_lambert_noise(
    line_integrals: ArrayLike,
    dose: float,
    electronic_noise: float,
    rng: np.random.Generator,
    light: ArrayLike = 1.0,
    lag: float = 0.0,
) -> NDArray[np.float32]:
    """-ln(counts/dose), counts clamped at `COUNT_FLOOR`; negatives are kept, else air would attenuate. Arguments, result and
    errors as in `tigre_noise`. Lag λ mixes the photons of successive frames; electronic noise comes after it."""
    _check(line_integrals, dose, electronic_noise)
    expected = beer_lambert_counts(line_integrals, dose)
    share = np.asarray(light, dtype=np.float64)
    counts = add_lag(sample_counts(expected * share, 0.0, rng), lag)
    if electronic_noise > 0:
        counts += rng.normal(0.0, electronic_noise, counts.shape)
    return _log_ratio(counts, dose * share).astype(np.float32)


def _attenuated(p: Array, dose: float) -> Array:
    # Very negative line integrals, as ringing can make them, would overflow to infinite counts.
    return np.exp(np.minimum(np.log(dose) - p, 700.0))


def _log_ratio(counts: Array, dose: float | Array) -> Array:
    return np.log(dose) - np.log(np.maximum(counts, COUNT_FLOOR))


def _check(line_integrals: ArrayLike, dose: float, electronic_noise: float) -> None:
    positive("dose", dose)
    at_least("electronic noise", electronic_noise, 0.0)
    finite("line integrals", line_integrals)
