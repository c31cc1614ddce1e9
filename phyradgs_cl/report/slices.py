"""The slices that a page can show: every one of a small volume, evenly chosen ones of a large one."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.fields import Grid
from phyradgs_cl.report.png import bytes_of, diverging, png_bytes, upright
from phyradgs_cl.report.preview import grey_range

LONGEST_EDGE = 192  # pixels of a slice in the page
BUDGET_PIXELS = 16_000_000  # of all slices together: some 20 MB of page at worst, of pure noise
# Plane, axis of the array that is cut, and the world axes to the right and up in the picture.
PLANES = (("axial", 0, "z", "x", "y"), ("coronal", 1, "y", "x", "z"), ("sagittal", 2, "x", "y", "z"))
Volume = NDArray[np.floating]


@dataclass(frozen=True)
class Plane:
    """The slices of one orientation. ``indices``: which of ``count`` slices; ``layers``: PNGs in base64, one an index.

    size_mm: (width, height) of a slice.
    """

    name: str
    axis: str
    right: str
    up: str
    count: int
    indices: list[int]
    positions_mm: list[float]
    size_mm: tuple[float, float]
    layers: dict[str, list[str]]


@dataclass(frozen=True)
class Windows:
    """What black and white stand for, in 1/mm, and the ends ± of the colours of a difference."""

    low: float
    high: float
    difference: float | None


def windows_of(volume: Volume, reference: Volume | None) -> Windows:
    """The truth's range serves both where there is one, so that a wrong gain shows."""
    if reference is None or not float(reference.max()) > 0:
        return Windows(*grey_range(volume), None)
    low, high = min(0.0, float(reference.min())), float(reference.max())
    limit = float(np.percentile(np.abs(volume - reference), 99.9)) or high
    return Windows(low, high, limit)


def planes_of(volume: Volume, reference: Volume | None, grid: Grid, windows: Windows) -> list[Plane]:
    """The three orientations of a volume (nz, ny, nx), with the truth and the difference where there is a truth."""
    layers: dict[str, Volume] = {"result": volume}
    if reference is not None and windows.difference is not None:
        layers |= {"truth": reference, "difference": volume - reference}
    kept = _kept_slices(volume.shape, len(layers))
    planes = []
    for (name, axis, letter, right, up), count in zip(PLANES, kept, strict=True):
        indices = np.unique(np.linspace(0, volume.shape[axis] - 1, count).round().astype(int)).tolist()
        centres_mm = grid.axes_mm()[axis]
        height_mm, width_mm = (side for a, side in enumerate(grid.size_mm) if a != axis)
        pictures = {key: [_picture(key, v, axis, i, windows) for i in indices] for key, v in layers.items()}
        positions_mm = [float(centres_mm[i]) for i in indices]
        size_mm = (width_mm, height_mm)
        planes.append(
            Plane(name, letter, right, up, volume.shape[axis], indices, positions_mm, size_mm, pictures)
        )
    return planes


def _kept_slices(shape: tuple[int, ...], layers: int) -> list[int]:
    """How many slices along every axis: all, or equal shares of the budget."""
    seen = [min(n, LONGEST_EDGE) for n in shape]
    pixels = [int(np.prod(seen)) // seen[axis] for axis in range(3)]
    most = max(1, BUDGET_PIXELS // (layers * sum(pixels)))
    return [min(n, most) for n in shape]


def _picture(layer: str, volume: Volume, axis: int, index: int, windows: Windows) -> str:
    image = _reduced(np.take(volume, index, axis=axis))
    if layer == "difference" and windows.difference is not None:
        png = png_bytes(upright(bytes_of(image, -windows.difference, windows.difference)), diverging())
    else:
        png = png_bytes(upright(bytes_of(image, windows.low, windows.high)))
    return base64.b64encode(png).decode("ascii")


def _reduced(image: Volume) -> Volume:
    """Means over blocks of pixels where an image (rows, columns) is longer than a page shows."""
    for axis in (0, 1):
        edge = image.shape[axis]
        if edge > LONGEST_EDGE:
            starts = (np.arange(LONGEST_EDGE) * edge) // LONGEST_EDGE
            sums = np.add.reduceat(image.astype(np.float64), starts, axis=axis)
            lengths = np.diff([*starts, edge])
            image = sums / (lengths[:, None] if axis == 0 else lengths)
    return image
