"""Detector lag: a panel gives back part of what it saw in the frames before, added and undone in intensity.

One exponential, from frame to frame: y_f = (1 − λ) x_f + λ y_(f−1), y before the first frame 0 (beam off). For what lag
does to reconstructions: Tilley et al., arXiv:1805.11631.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector.attenuation import TRANSMISSION_FLOOR


def add_lag(signal: ArrayLike, lag: float) -> NDArray[np.float64]:
    """Signals (F, ...) as a panel with the lag λ records them, in the order of the frames, float64."""
    recorded = np.array(signal, dtype=np.float64)
    if lag == 0:
        return recorded
    recorded[0] *= 1 - lag
    for f in range(1, len(recorded)):
        recorded[f] = (1 - lag) * recorded[f] + lag * recorded[f - 1]
    return recorded


def lagged(line_integrals: ArrayLike, lag: float) -> NDArray[np.float64]:
    """Line integrals (F, ...) that a panel with lag shows, without noise, float64."""
    p = np.asarray(line_integrals, dtype=np.float64)
    return p.copy() if lag == 0 else -np.log(add_lag(np.exp(-p), lag))


def without_lag(scan: Scan) -> Scan:
    """The scan as a panel without lag had recorded it; the scan itself if its lag is 0. Values at or below
    ``TRANSMISSION_FLOOR``, or that need a masked pixel of this or the previous frame, are masked. Photon noise comes
    back as it was; noise added after the panel grows by √(1 + λ²)/(1 − λ)."""
    if scan.lag == 0:
        return scan
    projections = np.empty(scan.projections.shape, np.float32)
    bad = np.zeros(projections.shape, bool)
    before = np.zeros(projections.shape[1:])
    for f, frame in enumerate(scan.projections):  # one at a time: float64 copies of a whole scan are large
        recorded = np.exp(-frame.astype(np.float64))
        signal = (recorded - scan.lag * before) / (1 - scan.lag)
        bad[f] = ~(signal > TRANSMISSION_FLOOR)
        projections[f] = -np.log(np.maximum(signal, TRANSMISSION_FLOOR))
        before = recorded
    return replace(scan, projections=projections, pixel_mask=_united(scan.pixel_mask, bad), lag=0.0)


def _united(mask: np.ndarray | None, bad: np.ndarray) -> np.ndarray | None:
    """``bad`` (F, v, u) and ``mask``, each frame's also in the frame after; None where nothing is masked."""
    if mask is None:
        return bad if bad.any() else None
    spread = np.asarray(mask) != 0
    if spread.ndim == 3:
        spread = spread | np.concatenate([spread[:1], spread[:-1]])
    return spread | bad if bad.any() else spread
