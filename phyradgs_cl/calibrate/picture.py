"""What is left of a few frames before and after, side by side."""

import numpy as np

from phyradgs_cl.calibrate.finding import Calibration
from phyradgs_cl.report.pictures.png import bytes_of, diverging, png_bytes, top_row_first

_ROWS = 4
_LEAST_PIXELS = 160  # of a frame's longer side
_GAP = 4


def residual_picture(calibration: Calibration) -> bytes:
    """A PNG: four frames from top to bottom, residuals before on the left and after on the right, blue below and red above
    what the volume explains, all on one scale."""
    before, after = calibration.before, calibration.after
    frames = np.unique(np.linspace(0, len(before) - 1, _ROWS).round().astype(int))
    largest = float(np.percentile(np.abs(before[frames]), 99.5)) or 1.0
    factor = max(1, -(-_LEAST_PIXELS // max(before.shape[1:])))
    pairs = [np.hstack([_large(side[f], largest, factor) for side in (before, after)]) for f in frames]
    return png_bytes(np.vstack(pairs), diverging())


def _large(image: np.ndarray, largest: float, factor: int) -> np.ndarray:
    """An image (rows, columns) as bytes, each pixel ``factor`` wide, in a margin of the colour of 0."""
    pixels = top_row_first(bytes_of(image, -largest, largest))
    return np.pad(np.kron(pixels, np.ones((factor, factor), np.uint8)), _GAP, constant_values=128)
