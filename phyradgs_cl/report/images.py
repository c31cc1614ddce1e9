"""Makes pictures for the report: values as grey or coloured PNG, and a volume's slices within the page's budget of
pixels."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.fields import Grid

LONGEST_EDGE = 192  # larger slices are averaged over blocks to at most this many pixels along each side
BUDGET_PIXELS = 16_000_000  # pixels of all slices together: pure noise, the worst case, makes a page of some 20 MB
# For each plane: name, letter of the axis across it, and the world axes to the right and up in the picture.
PLANES = (("axial", "z", "x", "y"), ("coronal", "y", "x", "z"), ("sagittal", "x", "y", "z"))
_ROOM = 0.25  # users may move black and white outwards by this fraction of their initial distance
_BLUE, _WHITE, _RED = (33, 86, 158), (247, 247, 245), (178, 34, 40)
_PERCENTILE = 99.9  # this percentile of the values is white, since a few very bright voxels would make all others dark
Volume = NDArray[np.floating]


def png_bytes(image: NDArray[np.uint8], colours: NDArray[np.uint8] | None = None) -> bytes:
    """Returns a PNG of an image (rows, columns) uint8, row 0 at the top. colours: (256, 3) uint8, None for grey."""
    from PIL import Image  # here, since most commands draw no picture and the import takes 0.1 s

    picture = Image.fromarray(image)
    if colours is not None:
        picture.putpalette(colours.tobytes())
    stream = io.BytesIO()
    picture.save(stream, "PNG", compress_level=9)
    return stream.getvalue()


def data_uri(png: bytes) -> str:
    return f"data:image/png;base64,{base64_of(png)}"


def base64_of(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def bytes_of(image: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint8]:
    """Maps ``low`` to ``high`` onto 0 to 255, clipped, for values of any shape. NaN and infinity become 0."""
    span = high - low if high > low else 1.0
    share = np.nan_to_num((image.astype(np.float64) - low) / span)
    return np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)


def top_row_first(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Flips an image (rows, columns) whose row 0 is the lowest, since row 0 of a picture file is its top."""
    return np.ascontiguousarray(image[::-1])


def grey_png(image: NDArray[np.floating], low: float, high: float) -> bytes:
    """Returns a PNG of an image (rows, columns) whose row 0 is the lowest: ``low`` is black, ``high`` white."""
    return png_bytes(top_row_first(bytes_of(image, low, high)))


def signed_png(image: NDArray[np.floating], limit: float) -> bytes:
    """Returns a PNG of differences (rows, columns), row 0 the lowest: −``limit`` is blue, +``limit`` red."""
    return png_bytes(top_row_first(bytes_of(image, -limit, limit)), diverging())


def diverging() -> NDArray[np.uint8]:
    """Returns colours (256, 3) for differences, from blue over white to red."""
    at = np.linspace(-1, 1, 256)[:, None]
    ends = np.where(at < 0, np.array(_BLUE), np.array(_RED))
    # the power below 1 makes small differences visible on white
    mixed = np.array(_WHITE) + np.abs(at) ** 0.8 * (ends - np.array(_WHITE))
    return np.rint(mixed).astype(np.uint8)


def grey_range(volume: NDArray[np.floating]) -> tuple[float, float]:
    """Returns the values of black and white: 0 and the volume's 99.9th percentile, or its extremes if that is 0 or less."""
    high = float(np.percentile(volume, _PERCENTILE))
    if high > 0:
        return 0.0, high
    low, high = float(volume.min()), float(volume.max())
    return low, high if high > low else low + 1.0


@dataclass(frozen=True)
class Window:
    """Grey values in 1/mm. low, high: black and white when the page opens. least, most: the range of the 256 stored
    levels, within which users may move black and white. beyond: whether values lie below ``least``, and above ``most``."""

    low: float
    high: float
    least: float
    most: float
    beyond: tuple[bool, bool]

    @classmethod
    def of(cls, low: float, high: float, *volumes: Volume) -> "Window":
        """Returns a window whose levels go beyond ``low`` and ``high``, if values do, by up to a quarter of high − low."""
        room = _ROOM * (high - low)
        lowest, highest = (float(f([f(v) for v in volumes])) for f in (np.min, np.max))
        least, most = min(low, max(lowest, low - room)), max(high, min(highest, high + room))
        return cls(low, high, least, most, (lowest < least, highest > most))


@dataclass(frozen=True)
class Plane:
    """The slices of one orientation. indices: which of all ``count`` slices the page has.

    layers: PNGs in base64 for each of result, truth, difference and error bar. first_mm, step_mm: the centre of slice 0 and
    the distance to the next. size_mm: (width, height). right, up: the world axes in the picture. still: a PNG of the
    middle slice, for browsers without scripts."""

    name: str
    axis: str
    right: str
    up: str
    count: int
    indices: list[int]
    first_mm: float
    step_mm: float
    size_mm: tuple[float, float]
    layers: dict[str, list[str]]
    still: bytes

    @property
    def middle(self) -> int:
        """Index into ``indices`` of the middle slice, which ``still`` shows."""
        return len(self.indices) // 2

def windows_of(volume: Volume, reference: Volume | None, doubt: Volume | None = None) -> dict[str, Window]:
    """Returns the grey values of each layer: "result", "truth" (``reference``), "difference", "doubt" (the error bars).
    Result and truth share the reference's range, so that a wrong scale of the result shows."""
    if doubt is not None:
        return {**windows_of(volume, reference), "doubt": Window.of(*grey_range(doubt), doubt)}
    if reference is None or not float(reference.max()) > 0:
        return {"result": Window.of(*grey_range(volume), volume)}
    grey = Window.of(min(0.0, float(reference.min())), float(reference.max()), volume, reference)
    size = np.abs(volume - reference)
    limit = float(np.percentile(size, 99.9)) or grey.high
    return {"result": grey, "truth": grey, "difference": Window.of(-limit, limit, size, -size)}


def planes_of(
    volume: Volume, reference: Volume | None, grid: Grid, windows: Mapping[str, Window], doubt: Volume | None = None
) -> list[Plane]:
    """Returns the three orientations of a volume (nz, ny, nx) in 1/mm, with a picture of every layer in ``windows``."""
    layers: dict[str, Volume] = {"result": volume}
    if reference is not None and "truth" in windows:
        layers |= {"truth": reference, "difference": volume - reference}
    if doubt is not None:
        layers["doubt"] = doubt
    planes = []
    for axis, count in enumerate(_slice_counts(volume.shape, len(layers))):
        indices = np.unique(np.linspace(0, volume.shape[axis] - 1, count).round().astype(int)).tolist()
        pictures = {
            key: [base64_of(_picture(v, axis, i, windows[key].least, windows[key].most)) for i in indices]
            for key, v in layers.items()
        }
        first = windows["result"]
        still = _picture(volume, axis, indices[len(indices) // 2], first.low, first.high)
        planes.append(_plane(grid, axis, indices, pictures, still))
    return planes


def middle_slices(volume: Volume) -> tuple[Volume, ...]:
    """Returns the middle slices (axial, coronal, sagittal) of a volume (nz, ny, nx)."""
    return tuple(np.take(volume, n // 2, axis=axis) for axis, n in enumerate(volume.shape))


def middle_planes(slices: Sequence[Volume], grid: Grid, window: tuple[float, float]) -> list[Plane]:
    """Returns planes of a volume's middle slices (axial, coronal, sagittal). window: the values of black and white."""
    stills = [grey_png(block_means(image, LONGEST_EDGE), *window) for image in slices]
    return [_plane(grid, axis, [grid.shape[axis] // 2], {}, still) for axis, still in enumerate(stills)]


def _plane(grid: Grid, axis: int, indices: list[int], layers: dict[str, list[str]], still: bytes) -> Plane:
    height_mm, width_mm = (side for a, side in enumerate(grid.size_mm) if a != axis)
    place = grid.first_centre_mm[axis], grid.voxel_size_mm[axis], (width_mm, height_mm)
    return Plane(*PLANES[axis], grid.shape[axis], indices, *place, layers, still)


def _slice_counts(shape: tuple[int, ...], layers: int) -> list[int]:
    """Returns how many slices the page has along each axis: all, or as many as ``BUDGET_PIXELS`` allows."""
    edges = [min(n, LONGEST_EDGE) for n in shape]
    pixels = [int(np.prod(edges)) // edges[axis] for axis in range(3)]
    most = max(1, BUDGET_PIXELS // (layers * sum(pixels)))
    return [min(n, most) for n in shape]


def _picture(volume: Volume, axis: int, index: int, low: float, high: float) -> bytes:
    return grey_png(block_means(np.take(volume, index, axis=axis), LONGEST_EDGE), low, high)


def block_means(values: Volume, most_edge: int) -> Volume:
    """Averages an array over blocks, so that no axis is longer than ``most_edge``."""
    for axis, edge in enumerate(values.shape):
        if edge > most_edge:
            starts = (np.arange(most_edge) * edge) // most_edge
            lengths = np.diff([*starts, edge]).reshape([-1 if a == axis else 1 for a in range(values.ndim)])
            values = np.add.reduceat(values, starts, axis=axis, dtype=np.float64) / lengths
    return values
