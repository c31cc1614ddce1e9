"""How far each measured line integral can be trusted: the variance of −ln(counts) is one over the counts."""

import numpy as np
from numpy.typing import NDArray


def transmission_weights(
    line_integrals: NDArray[np.float32], valid: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Weights exp(−p) of a scan's pixels p (F, v, u), scaled to the mean 1 over those that are ``valid`` (None: all).

    Those of least squares for photon noise (Sauer and Bouman, IEEE Trans. Signal Process. 41 (1993) 534). What lies below 0
    counts as air: noise should not be trusted more for being bright.
    """
    weights = np.exp(-np.maximum(line_integrals, 0)).astype(np.float32)
    if valid is None:
        mean = float(weights.mean(dtype=np.float64))
    else:
        chosen = np.broadcast_to(valid, weights.shape)
        mean = float(weights.mean(dtype=np.float64, where=chosen)) if chosen.any() else 1.0
    return weights / np.float32(mean) if mean > 0 else np.ones_like(weights)
