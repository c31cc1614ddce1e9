"""How a detector averages what it sees while the beam or the object moves."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import finite, one_of, shape
from phyradgs_cl.errors import InputError

MODELS = ("log", "intensity")
_WEIGHT_TOLERANCE = 1e-6  # what weights summed in float32 may miss 1 by


def average(p: ArrayLike, weight: ArrayLike, model: str) -> NDArray[np.float64]:
    """Line integrals (...) float64 of one exposure from those at several times, p (S, ...).

    "log" is their mean (PhyRadGS, Eq. 1), "intensity" what a detector does: it adds photons, P = -ln(sum of w · exp(-p)),
    without overflow at any p. weight (S,): share of the exposure, not negative, sum 1. InputError: unknown model, shapes
    that do not fit, weights negative or not adding to 1, NaN.
    """
    one_of("detector model", model, MODELS)
    values, weights = np.asarray(p, dtype=np.float64), np.asarray(weight, dtype=np.float64)
    if values.ndim == 0 or values.shape[0] == 0:
        raise InputError("line integrals", f"shape {values.shape}", "shape (S, ...) with at least one time")
    shape("weight", weights, (values.shape[0],))
    finite("weight", weights)
    finite("line integrals", values)
    if (weights < 0).any() or abs(weights.sum() - 1) > _WEIGHT_TOLERANCE:
        raise InputError("weight", f"sum {weights.sum():g}, least {weights.min():g}", "not negative, sum 1")
    return np.tensordot(weights, values, axes=1) if model == "log" else intensity_average(values, weights)[0]


def intensity_average(
    p: Iterable[np.ndarray], weights: Iterable[np.ndarray]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """−ln Σ w exp(−p) over S times, and each time's share w exp(−p) / Σ w exp(−p), without overflow. p: S arrays of the
    result's precision. weights: S numbers or arrays that broadcast, sum 1; where all are 0, so are both results."""
    pairs = list(zip(p, weights, strict=True))
    least = np.minimum.reduce([np.where(w > 0, q, np.inf) for q, w in pairs])  # of the brightest time
    least = np.where(np.isfinite(least), least, 0)
    seen = [w * np.exp(np.where(w > 0, least - q, 0)) for q, w in pairs]
    total = np.sum(seen, axis=0)
    inverse = np.divide(1, total, out=np.zeros_like(total), where=total > 0)
    return least - np.log(np.where(total > 0, total, 1)), [part * inverse for part in seen]
