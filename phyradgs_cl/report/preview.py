"""Shows a volume without a report: its middle slices as a PNG, which a run can also renew until it ends, or the whole volume
in napari."""

import logging
import math
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl import checks
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError, PhyradgsError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import Volume, file_kind, partial_path, read_scan, read_volume, written_beside
from phyradgs_cl.reconstructors import Progress
from phyradgs_cl.report.images import bytes_of, grey_range, png_bytes, top_row_first

_GAP = 4  # pixels between two slices
_SMALLEST, _LARGEST = 128, 512  # least and most pixels along the volume's longest side
log = logging.getLogger(__name__)


def write_preview(volume: NDArray[np.floating], grid: Grid, path: str | Path) -> None:
    """Writes a grey PNG of a volume's (nz, ny, nx) middle slices in true proportions, completely or not at all.

    From left to right they are axial (y up), coronal and sagittal (z up). Raises InputError for a volume that does not fit
    its grid, NaN and infinity, and OutputError if the file cannot be written."""
    checks.shape("volume", volume, grid.shape)
    checks.finite("volume", volume)
    picture = png_bytes(preview_image(volume, grid))
    with written_beside(path) as temporary:
        temporary.write_bytes(picture)


class Preview:
    """Writes a picture of the volume during a run; call it with each progress report.

    During the run the file is ``io.partial_path(path)``, made at most every ``every_s`` s. A failure gives one warning."""

    def __init__(self, path: Path, every_s: float = 5.0) -> None:
        self.path, self.partial, self.every_s = path, partial_path(path), every_s
        self._last_s = -math.inf
        self._failed = False

    def __call__(self, progress: Progress) -> None:
        if progress.volume is None or time.monotonic() - self._last_s < self.every_s:
            return
        self._write(*progress.volume(), self.partial)
        self._last_s = time.monotonic()

    def finish(self, volume: NDArray[np.floating], grid: Grid) -> None:
        """Writes the picture of the result, and removes the one made during the run."""
        self._write(volume, grid, self.path)
        with suppress(OSError):
            self.partial.unlink()

    def _write(self, volume: NDArray[np.floating], grid: Grid, path: Path) -> None:
        try:
            write_preview(volume, grid, path)
        except PhyradgsError as error:
            if not self._failed:
                log.warning("no preview: %s", error)
            self._failed = True


def preview_image(volume: NDArray[np.floating], grid: Grid) -> NDArray[np.uint8]:
    """Returns a picture (rows, columns) uint8 of the middle slices, aligned at the bottom. Row 0 is the top."""
    low, high = grey_range(volume)
    per_mm = np.clip(max(grid.shape), _SMALLEST, _LARGEST) / max(grid.size_mm)
    slices = []
    for axis in _shown_axes(grid):
        image = bytes_of(np.take(volume, volume.shape[axis] // 2, axis=axis), low, high)
        shape = [max(1, round(side * per_mm)) for a, side in enumerate(grid.size_mm) if a != axis]
        ends = zip(shape, image.shape, strict=True)  # pixels take their nearest voxel, so that single voxels stay visible
        rows, columns = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in ends)
        slices.append(top_row_first(image[rows[:, None], columns]))
    height = max(one.shape[0] for one in slices)
    return np.hstack([np.pad(one, ((height - one.shape[0], 0), (0, _GAP))) for one in slices])[:, :-_GAP]


def _shown_axes(grid: Grid) -> list[int]:
    """Returns the axes (0 z, 1 y, 2 x) along which slices are cut: all, but only one for a grid one voxel thick."""
    across = [min(n for a, n in enumerate(grid.shape) if a != axis) for axis in range(3)]
    return [axis for axis in range(3) if across[axis] > 1] or [0, 1, 2]


_AXES = ("z", "y", "x")
Layer = tuple[np.ndarray, dict[str, Any], str]


def view_volume(path: Path) -> None:
    """Opens a volume file in a window of napari, and returns when it is closed.

    Raises InputError if napari is missing, and for anything but a volume file of phyradgs-cl."""
    napari = checks.package("napari", "the package for this, 0.5.4 or later", "phyradgs-cl[view]")
    if (kind := file_kind(path)) != "volume":
        raise InputError(str(path), f"a {kind}", "a volume of phyradgs-cl")
    viewer, stored = napari.Viewer(title=f"{path.name} – phyradgs"), read_volume(path)
    viewer.add_image(stored.values, **_look_of_volume(stored, path.stem))
    viewer.dims.axis_labels = _AXES
    if hasattr(viewer.camera, "orientation2d"):  # napari 0.6 and later; in earlier ones y points down
        viewer.camera.orientation2d = ("up", "right")
    # napari 0.9 moved overlays to its canvas
    overlays = viewer.canvas.overlays if hasattr(viewer, "canvas") else viewer
    overlays.scale_bar.visible = True
    napari.run()


def napari_reader(path: str | list[str]) -> Callable[[str | list[str]], list[Layer]] | None:
    """Returns the function with which napari reads this package's volumes and scans; None for other .h5 files."""
    paths = [path] if isinstance(path, str) else path
    with suppress(PhyradgsError):
        if all(file_kind(one) in ("volume", "scan") for one in paths):
            return lambda _: [napari_layer(Path(one)) for one in paths]
    return None


def napari_layer(path: Path) -> Layer:
    """Reads a volume (z, y, x) in mm, or a scan (projection, v, u), as napari's (values, arguments of add_image, "image").
    Rows and columns of a scan are in mm from the central ray. Row 0 is the lowest."""
    if file_kind(path) == "volume":
        stored = read_volume(path)
        return stored.values, _look_of_volume(stored, path.stem), "image"
    scan = read_scan(path, counts_to_attenuation)
    sides = zip(scan.geometry.detector_shape, scan.geometry.pixel_size_mm, scan.geometry.detector_offset_mm, strict=True)
    first_mm = [offset - (count - 1) / 2 * pitch for count, pitch, offset in sides]
    values = np.asarray(scan.projections)
    look = {
        "name": f"{path.stem} (line integrals)", "scale": (1.0, *scan.geometry.pixel_size_mm), "translate": (0.0, *first_mm),
        "units": ("pixel", "mm", "mm"), "axis_labels": ("projection", "v", "u"),
        "contrast_limits": grey_range(values), "colormap": "gray",
    }  # fmt: skip
    return values, look, "image"


def _look_of_volume(stored: Volume, name: str) -> dict[str, Any]:
    grid = stored.required_grid
    return {
        "name": f"{name} (1/mm)", "scale": grid.voxel_size_mm, "translate": grid.first_centre_mm,
        "units": ("mm", "mm", "mm"), "axis_labels": _AXES, "contrast_limits": grey_range(stored.values), "colormap": "gray",
    }  # fmt: skip
