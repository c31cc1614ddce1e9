"""Masked pixels filled in from their neighbours, for methods and steps that cannot leave pixels out."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition import Scan


def unmasked_frames(scan: Scan) -> np.ndarray:
    """The scan's line integrals (F, v, u) with masked pixels filled in."""
    if scan.pixel_mask is None:
        return scan.projections
    return fill_masked(scan.projections, ~scan.valid)


def fill_masked(frames: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Frames (F, v, u) with masked pixels linearly interpolated along their row; rows without any other pixel along their
    columns, between the rows that have some (0 in a frame without any)."""
    filled = frames.copy()
    empty: np.ndarray = np.asarray(mask.all(axis=-1))
    for f, v in zip(*np.nonzero(mask.any(axis=-1) & ~empty), strict=True):
        bad = mask[f, v]
        good = np.flatnonzero(~bad)
        filled[f, v, bad] = np.interp(np.flatnonzero(bad), good, filled[f, v, good])
    for f in np.flatnonzero(empty.any(axis=-1)):
        filled[f, empty[f]] = _between_rows(filled[f], np.flatnonzero(~empty[f]), np.flatnonzero(empty[f]))
    return filled


def _between_rows(frame: np.ndarray, good: np.ndarray, bad: np.ndarray) -> np.ndarray | float:
    """Rows ``bad`` of a frame (v, u), from its rows ``good``."""
    if good.size == 0:
        return 0.0
    after = np.clip(np.searchsorted(good, bad), 1, max(good.size - 1, 1))
    low, high = good[after - 1], good[np.minimum(after, good.size - 1)]
    share = np.clip((bad - low) / np.maximum(high - low, 1), 0, 1)[:, None]
    return (1 - share) * frame[low] + share * frame[high]


def with_masked(scan: Scan, bad: np.ndarray) -> Scan:
    """The scan with pixels ``bad`` (v, u) or (F, v, u) masked as well, and filled in for whoever does not ask the mask."""
    if not bad.any():
        return scan
    mask = bad if scan.pixel_mask is None else (np.asarray(scan.pixel_mask) != 0) | bad
    filled = fill_masked(scan.projections, np.broadcast_to(mask, scan.projections.shape))
    return replace(scan, pixel_mask=mask, projections=filled)
