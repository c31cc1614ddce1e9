"""How images and volumes lie in device memory: rows with a pitch.

GUARD floats, then (rows, pitch), where every row ends in at least GUARD zeros. A vector of pixels may therefore start or end
outside a row without a test. Kernels know it as ``IMAGE_GUARD``.
"""

from __future__ import annotations

import numpy as np

from phyradgs_cl.runtime.context import Runtime
from phyradgs_cl.runtime.memory import DeviceArray

GUARD = 16


def pitch_of(width: int) -> int:
    return -(-width // GUARD) * GUARD + GUARD


def padded_zeros(rt: Runtime, rows: int, width: int, images: int = 1) -> DeviceArray:
    """Zeroed memory for ``images`` images or volumes of ``rows`` rows."""
    return rt.zeros(images * (GUARD + rows * pitch_of(width)) + GUARD)


def pad_rows(values: np.ndarray) -> np.ndarray:
    """(..., rows, width) float to the flat padded layout, float32."""
    width = values.shape[-1]
    rows = int(np.prod(values.shape[:-1], dtype=np.int64))
    flat = np.zeros(2 * GUARD + rows * pitch_of(width), np.float32)
    flat[GUARD : GUARD + rows * pitch_of(width)].reshape(rows, -1)[:, :width] = values.reshape(rows, width)
    return flat


def unpad_rows(flat: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The inverse of ``pad_rows`` for an image or volume of the given shape."""
    width, rows = shape[-1], int(np.prod(shape[:-1], dtype=np.int64))
    body = flat[GUARD : GUARD + rows * pitch_of(width)].reshape(rows, -1)
    return np.ascontiguousarray(body[:, :width]).reshape(shape)
