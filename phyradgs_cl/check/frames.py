"""Frames that stand out by themselves, before anything is reconstructed: black, bright, or the one before again."""

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.questions.timing import start_azimuths_rad, wrapped

_NORMAL_MAD = 1.4826
_DEVIATIONS = 12.0
_LEAST = 0.75  # of the usual mean line integral
_FEWEST = 5
_TWICE = 0.15  # of the usual difference between neighbours


def odd_ones(p: np.ndarray, mask: np.ndarray | None) -> list[int]:
    """Frames (F, v, u) whose mean line integral is far from that of those around them: an object turns, it does not jump."""
    if len(p) < _FEWEST:
        return []
    valid = 1.0 if mask is None else (np.asarray(mask) == 0).astype(np.float32)
    weight = np.broadcast_to(valid, p.shape)
    level = (p * weight).sum((1, 2), dtype=np.float64) / np.maximum(weight.sum((1, 2)), 1)
    apart = level - np.median(_around(level), axis=0)
    usual = _NORMAL_MAD * float(np.median(np.abs(apart - np.median(apart))))
    least = max(_DEVIATIONS * usual, _LEAST * abs(float(np.median(level))))
    return [int(f) for f in np.flatnonzero(np.abs(apart) > least)]


def alike(scan: Scan) -> list[int]:
    """Frames that repeat the one before, though the gantry has turned: they differ far less than neighbours do."""
    p = scan.projections
    if len(p) < _FEWEST:
        return []
    apart = np.array([float(np.square(b - a, dtype=np.float64).mean()) ** 0.5 for a, b in zip(p[:-1], p[1:], strict=True)])
    moved = np.abs(wrapped(np.diff(start_azimuths_rad(scan)))) > 1e-6
    return [int(f) + 1 for f in np.flatnonzero(moved & (apart < _TWICE * np.min(_around(apart), axis=0)))]


def _around(values: np.ndarray) -> np.ndarray:
    """(4, F): of every value (F,) the two before and the two behind, mirrored at the ends."""
    wide = np.r_[values[2:0:-1], values, values[-2:-4:-1]]
    return np.stack([wide[:-4], wide[1:-3], wide[3:-1], wide[4:]])
