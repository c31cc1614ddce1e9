"""What happens to a scan before any method sees it: another grid, lag undone, a median filter."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import without_lag
from phyradgs_cl.fields import GridChoice

MEDIAN_EDGES = (0, 3, 5)


@dataclass(frozen=True)
class InputOptions(GridChoice):
    """size, voxel_mm, roi_mm: the grid, as of ``GridChoice``. ignore_lag: leave the panel's lag in the frames.
    median_filter: edge of its window in pixels, 0 for none.
    """

    ignore_lag: bool = False
    median_filter: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.one_of("median_filter", self.median_filter, MEDIAN_EDGES)

    def facts(self) -> dict[str, object]:
        """What is chosen, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def prepared(scan: Scan, options: InputOptions) -> Scan:
    """The scan as a method gets it; the scan itself where nothing is to be done."""
    scan = scan.with_grid(options)
    if not options.ignore_lag:
        scan = without_lag(scan)
    if options.median_filter > 0:
        scan = replace(scan, projections=median_frames(scan, options.median_filter))
    return scan


def median_frames(scan: Scan, edge: int) -> np.ndarray:
    """Line integrals (F, rows, columns) float32, each the median of ``edge`` × ``edge`` pixels of its frame.

    Masked pixels are filled in from their row first, so that what they hold does not reach their neighbours.
    """
    frames = unmasked_frames(scan)
    smooth = [scipy.ndimage.median_filter(frame, size=edge, mode="nearest") for frame in frames]
    return np.stack(smooth).astype(np.float32)


def unmasked_frames(scan: Scan) -> np.ndarray:
    """The scan's line integrals with masked pixels filled in, for methods that cannot leave pixels out."""
    if scan.pixel_mask is None:
        return scan.projections
    return fill_masked(scan.projections, np.broadcast_to(scan.pixel_mask != 0, scan.projections.shape))


def fill_masked(frames: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Frames (F, v, u) with masked pixels linearly interpolated along their row (0 in a row without any)."""
    filled = frames.copy()
    for f, v in zip(*np.nonzero(mask.any(axis=-1)), strict=True):
        bad = mask[f, v]
        good = np.flatnonzero(~bad)
        filled[f, v, bad] = np.interp(np.flatnonzero(bad), good, filled[f, v, good]) if good.size else 0.0
    return filled
