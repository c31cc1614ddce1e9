"""Ramp filters: Ram-Lak in its space-domain form, and windows on its spectrum.

A. C. Kak and M. Slaney, Principles of Computerized Tomographic Imaging, IEEE Press 1988, Eq. 61 of chapter 3.
"""

from collections.abc import Callable

import numpy as np
import scipy

_WORKERS = -1  # all cores

# Of the frequency as a share of the Nyquist frequency; all are 1 at zero, so that no window changes the mean.
WINDOWS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "ram-lak": np.ones_like,
    "shepp-logan": lambda share: np.sinc(share / 2),
    "cosine": lambda share: np.cos(np.pi / 2 * share),
    "hamming": lambda share: 0.54 + 0.46 * np.cos(np.pi * share),
    "hann": lambda share: 0.5 + 0.5 * np.cos(np.pi * share),
}


def ramp_spectrum(length: int, window: str = "ram-lak") -> np.ndarray:
    """The filter's real spectrum (length // 2 + 1,) for a pitch of 1 and a period of ``length`` samples.

    Sampling |frequency| instead would put a false constant under every row.
    """
    n = np.minimum(np.arange(length), length - np.arange(length))
    kernel = np.where(n % 2 == 1, -1.0 / (np.pi * np.maximum(n, 1)) ** 2, 0.0)
    kernel[0] = 0.25
    spectrum = scipy.fft.rfft(kernel).real
    return spectrum * WINDOWS[window](np.arange(spectrum.size) / (length / 2))


def ramp_filter(rows: np.ndarray, spacing_mm: float, window: str = "ram-lak") -> np.ndarray:
    """The ramp filter along the last axis of (..., width), zero-padded so that nothing wraps around.

    Returns the same shape in float32 and units of ``rows`` per mm. Float32 rows stay float32 throughout.
    """
    width = rows.shape[-1]
    length = scipy.fft.next_fast_len(2 * width, real=True)
    spectrum = scipy.fft.rfft(rows, length, axis=-1, workers=_WORKERS)
    spectrum *= (ramp_spectrum(length, window) / spacing_mm).astype(spectrum.real.dtype)
    filtered = scipy.fft.irfft(spectrum, length, axis=-1, overwrite_x=True, workers=_WORKERS)
    return filtered[..., :width].astype(np.float32, copy=False)
