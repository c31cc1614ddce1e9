"""Quality without truth: pixels that a method does not see, and how far its volume is from them.

Cross-validation over pixels, as of one parameter in Golub, Heath and Wahba, Technometrics 21 (1979) 215. The pixels are the
same for every method, option and seed, so that their errors can be compared; what is compared is the volume, projected under
the scan's true motion.
"""

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import noise_rms
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.frames.pairs import frame_pairs
from phyradgs_cl.reconstructors.result import Reconstruction
from phyradgs_cl.runtime import Runtime

_SEED = 20
_FRAMES = 8  # that are projected at one time


def held_out(scan: Scan, percent: float, seed: int = _SEED, subject: str = "--holdout") -> np.ndarray:
    """Pixels (F, v, u) bool, so many percent of those that may be used, drawn once and for all. InputError for none."""
    drawn = np.random.default_rng(seed).random(scan.projections.shape, np.float32) < percent / 100
    held: np.ndarray = drawn & scan.valid
    if not held.any():
        raise InputError(subject, f"{percent:g} % of {int(scan.valid.sum())} pixels", "at least one pixel", "take more")
    return held


def holdout_errors(rt: Runtime, scan: Scan, held: np.ndarray, result: Reconstruction) -> dict[str, float]:
    """Root mean square of measured less computed line integrals over pixels (F, v, u) that were held out, dimensionless;
    beside it what their own noise makes of it, below which no volume comes by merit, and how many they are."""
    squares = 0.0
    for first in range(0, scan.frames, _FRAMES):
        frames = range(first, min(first + _FRAMES, scan.frames))
        for pair in frame_pairs(rt, scan, result.volume, result.grid, frames):
            squares += float(np.sum(np.square(pair.residual[held[pair.frame]], dtype=np.float64)))
    count = int(held.sum())
    noise = noise_rms(scan.projections, held, scan.valid)
    return {"holdout_rms": float(np.sqrt(squares / count)), "holdout_noise_rms": noise, "holdout_pixels": count}
