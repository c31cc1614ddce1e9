"""The padded layout of images and volumes in device memory: GUARD zeros, then rows that start ``pitch`` floats apart.

Every row is followed by at least GUARD zeros. Kernels can thus read a vector of pixels that starts or ends outside a row
without testing for it. Kernels call GUARD ``IMAGE_GUARD``."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from phyradgs_cl.checks import ceil_div, few_sizes
from phyradgs_cl.runtime.context import Runtime
from phyradgs_cl.runtime.memory import Array, DeviceArray, SameArray

GUARD = 16  # number of zeros before the first row, and least number of zeros after each row

_TILE = 16  # a CPU's work-item transposes a tile of this many rows and columns, which stays in the cache


@dataclass(frozen=True)
class Strides:
    """Offset and strides of a volume in memory, in floats: voxel (z, y, x) is at ``start`` + z ``slice`` + y ``row`` + x."""

    start: int
    slice: int
    row: int

    @classmethod
    def plain(cls, shape: Sequence[int], first: Sequence[int] = (0, 0, 0)) -> "Strides":
        """Returns the strides of an array of ``shape`` (nz, ny, nx) in C order, for its part from element ``first`` (z, y,
        x) on."""
        _, ny, nx = shape
        return cls((first[0] * ny + first[1]) * nx + first[2], ny * nx, nx)

    def vector(self) -> np.ndarray:
        return np.array([self.start, self.row, self.slice, 0], np.int64)


def move(
    rt: Runtime, source: tuple[DeviceArray, Strides], target: tuple[DeviceArray, Strides],
    shape: Sequence[int], *, turned: bool = False,
) -> None:
    """Copies floats of ``shape`` (nz, ny, nx) on the device from ``source`` to ``target``, each an array and its strides.
    turned: transposes to (nz, nx, ny)."""
    nz, ny, nx = (int(n) for n in shape)
    (from_array, from_strides), (to_array, to_strides) = source, target
    ends = from_array, from_strides.vector(), to_array, to_strides.vector(), np.int32(ny), np.int32(nx)
    if turned:
        tile = 1 if rt.pixel_items else _TILE
        kernel = rt.kernel("layout", "move_turned", TILE=tile)
        rt.launch(kernel, (ceil_div(nx, tile), ceil_div(ny, tile), nz), *ends, group=rt.group())
        return
    blocks = ceil_div(nx, rt.lanes)
    kernel = rt.kernel("layout", "move_rows", TILE=1)
    rt.launch(kernel, (blocks, ny, nz), *ends, group=rt.group(on_cpu=few_sizes(blocks, 8)))


def beside(rt: Runtime, volume: Array, out: DeviceArray | None) -> tuple[DeviceArray, DeviceArray]:
    """Returns a volume on the device (a NumPy array is uploaded), and memory for a result of its shape: ``out``, or new
    memory if ``out`` is None."""
    there = volume if isinstance(volume, DeviceArray) else rt.upload(volume, np.float32)
    return there, rt.empty(volume.shape) if out is None else out


def brought_to(rt: Runtime, like: SameArray, result: DeviceArray) -> SameArray:
    """Returns the device array ``result``, downloaded to NumPy if ``like`` is a NumPy array."""
    return cast(SameArray, result if isinstance(like, DeviceArray) else rt.download(result))


def pitch_of(width: int) -> int:
    return ceil_div(width, GUARD) * GUARD + GUARD


def padded_zeros(rt: Runtime, rows: int, width: int, images: int = 1) -> DeviceArray:
    """Returns zeros in the padded layout, for ``images`` images or volumes with ``rows`` rows of ``width`` floats each."""
    return rt.zeros(images * (GUARD + rows * pitch_of(width)) + GUARD)


def pad_rows(values: np.ndarray) -> np.ndarray:
    """Returns an image or volume (..., rows, width) as flat float32 in the padded layout."""
    width = values.shape[-1]
    rows = int(np.prod(values.shape[:-1], dtype=np.int64))
    flat = np.zeros(2 * GUARD + rows * pitch_of(width), np.float32)
    flat[GUARD : GUARD + rows * pitch_of(width)].reshape(rows, -1)[:, :width] = values.reshape(rows, width)
    return flat


def unpad_rows(flat: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Returns the image or volume of the given shape that ``pad_rows`` has turned into ``flat``."""
    width, rows = shape[-1], int(np.prod(shape[:-1], dtype=np.int64))
    body = flat[GUARD : GUARD + rows * pitch_of(width)].reshape(rows, -1)
    return np.ascontiguousarray(body[:, :width]).reshape(shape)
