"""Writes OME-Zarr 0.5: a folder of chunks, at full and at successively halved resolution, which viewers load as needed."""

from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.exporters.dicom import folder_written_beside
from phyradgs_cl.fields import Grid, Hounsfield
from phyradgs_cl.io.volume import Volume

_CHUNK = 64  # most voxels of a chunk along each axis; a level with no more along all axes is the last


def write_zarr(path: Path, volume: Volume, scale: Hounsfield | None) -> None:
    """Writes a new folder, slab by slab: besides the volume (nz, ny, nx) in 1/mm, memory holds at most 128 slices. A
    level's voxels are means of 2×2×2 voxels of the level before. scale: that of Hounsfield units to write; None writes
    1/mm. Raises OutputError as ``folder_written_beside`` does."""
    of_extra = "the package that this export needs", "phyradgs-cl[zarr]"
    writer, zarr = (checks.package(name, *of_extra) for name in ("ome_zarr.writer", "zarr"))
    grid, levels = volume.required_grid, list[dict[str, Any]]()
    factors = step = np.ones(3, int)
    before: Any = volume.values
    with folder_written_beside(path) as folder:
        group = zarr.open_group(str(folder), mode="a", zarr_format=3)
        while not levels or max(before.shape) > _CHUNK:
            shape, name = tuple((np.array(before.shape) // step).tolist()), f"s{len(levels)}"
            level = group.create_array(
                name, shape=shape, chunks=tuple(min(n, _CHUNK) for n in shape), dtype="float32",
                dimension_names=list("zyx"), config={"write_empty_chunks": True},  # so that a missing chunk means a lost one
            )  # fmt: skip
            for start in range(0, shape[0], _CHUNK):
                stop = min(start + _CHUNK, shape[0])
                slab = before[start * step[0] : stop * step[0]]
                slab = _means(slab, step) if levels else slab if scale is None else scale.of(slab)
                level[start:stop] = slab
            levels.append({"path": name, "coordinateTransformations": _places(grid, factors)})
            step = np.where(np.array(shape) > 1, 2, 1)
            factors, before = factors * step, level
        axes = [{"name": axis, "type": "space", "unit": "millimeter"} for axis in "zyx"]
        note = {"values": "values in 1/mm" if scale is None else scale.note}
        writer.write_multiscales_metadata(group, levels, axes=axes, name=path.name, metadata=note)


def _means(slab: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Returns the means of a slab (z, y, x) over blocks of ``step`` (3,) voxels. Voxels that fill no block are left out."""
    (nz, ny, nx), (z, y, x) = np.array(slab.shape) // step, step
    cut = slab[: nz * z, : ny * y, : nx * x]
    return cut.reshape(nz, z, ny, y, nx, x).mean((1, 3, 5), dtype=np.float32)


def _places(grid: Grid, factors: np.ndarray) -> list[dict[str, object]]:
    """Returns OME's scale and translation in mm of voxels ``factors`` (3,) times as large as the grid's."""
    first_mm = grid.first_centre_mm + (factors - 1) / 2 * grid.voxel_size_mm
    sizes = {"type": "scale", "scale": (factors * grid.voxel_size_mm).tolist()}
    return [sizes, {"type": "translation", "translation": first_mm.tolist()}]
