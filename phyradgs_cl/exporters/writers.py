"""Writes voxels as NIfTI, NRRD and MetaImage (by SimpleITK), as TIFF like ImageJ's, as NumPy and as OME-Zarr; Gaussians as
PLY and NumPy.

The world's x, y, z are written as left, posterior, superior (LPS, the frame of DICOM and ITK). So z, the rotation axis, is
up in every viewer. A slice looks the same in viewers that know directions and in viewers that show row 0 at the top."""

import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters.dicom import folder_written_beside
from phyradgs_cl.fields import Grid, Hounsfield, triple
from phyradgs_cl.io.output import written_beside
from phyradgs_cl.io.volume import Volume
from phyradgs_cl.metrics.align import block_means

_WRITERS = {".mha": "MetaImageIO", ".nii": "NiftiImageIO", ".nii.gz": "NiftiImageIO", ".nrrd": "NrrdImageIO"}
_MOST_NIFTI_VOXELS = 32_767  # NIfTI allows at most this many voxels along an axis
_MOST_IMAGEJ_BYTES = 4_000_000_000  # from this size on BigTIFF is written: offsets in ImageJ's TIFF have 32 bits
_CHUNK = 64  # voxels of a chunk along each axis; the resolution is halved until the volume fits into one chunk
log = logging.getLogger(__name__)
_PLY_NAMES = ("x", "y", "z", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "density")


def write_image(path: Path, volume: Volume, note: str, times_s: Sequence[float] = (), states: Sequence[Volume] = ()) -> None:
    """Writes NIfTI, NRRD or MetaImage, by the suffix. note: "values in 1/mm", or "values in HU" with their scale. states:
    the object at ``times_s``, written in place of ``volume`` as one file of four dimensions. Warns of times that are not
    evenly spaced. Raises InputError for more voxels than NIfTI allows."""
    sitk = checks.package("SimpleITK", "the package that this export needs", "phyradgs-cl[formats]")
    suffix = next(suffix for suffix in reversed(_WRITERS) if path.name.lower().endswith(suffix))
    if suffix.startswith(".nii") and max(volume.values.shape) > _MOST_NIFTI_VOXELS:
        raise InputError("--to nii", f"{max(volume.values.shape)} voxels", f"at most {_MOST_NIFTI_VOXELS}", "use --to nrrd")
    images = [sitk.GetImageFromArray(each.values) for each in states or (volume,)]
    for image in images:
        image.SetSpacing(volume.required_grid.voxel_size_mm[::-1])
        image.SetOrigin(volume.required_grid.first_centre_mm[::-1])
    if states:
        step_s = float(times_s[-1] - times_s[0]) / (len(times_s) - 1) if len(times_s) > 1 else 1.0
        if not np.allclose(np.diff(times_s), step_s, rtol=1e-3):
            text = "%s: the file has one step between states, %.4g s; theirs are uneven: %s s"
            log.warning(text, path, step_s, np.asarray(times_s).tolist())
        image = sitk.JoinSeries(images, float(times_s[0]), step_s)
    image.SetMetaData("ITK_FileNotes", note)
    with written_beside(path, len(images) * volume.values.nbytes, suffix) as temporary:
        writer = sitk.ImageFileWriter()
        writer.SetImageIO(_WRITERS[suffix])
        writer.SetFileName(str(temporary))
        writer.SetUseCompression(suffix == ".nii.gz")
        writer.Execute(image)


def write_tiff(path: Path, volume: Volume, note: str) -> None:
    """Writes a TIFF with a page per slice from the lowest up, row 0 at the smallest y. Sizes are in mm, the origin in
    pixels. Volumes of 4 GB and more become BigTIFF, which ImageJ opens through Bio-Formats."""
    tifffile = checks.package("tifffile", "the package that this export needs", "phyradgs-cl[formats]")
    dx, dy, dz = volume.required_grid.voxel_size_mm[::-1]
    first_mm = volume.required_grid.first_centre_mm[::-1]
    facts = {
        "axes": "ZYX", "spacing": dz, "unit": "mm", "min": float(volume.values.min()),
        "max": float(volume.values.max()),
        **{f"{axis}origin": -place / step for axis, place, step in zip("xyz", first_mm, (dx, dy, dz), strict=True)},
        "Info": note,
    }  # fmt: skip
    is_small = volume.values.nbytes < _MOST_IMAGEJ_BYTES
    with written_beside(path) as temporary:
        tifffile.imwrite(
            temporary, volume.values, imagej=is_small, bigtiff=not is_small, resolution=(1 / dx, 1 / dy),
            resolutionunit="NONE", metadata=facts, photometric="minisblack",
        )


def write_npy(path: Path, volume: Volume, note: str) -> None:
    """Writes the values (z, y, x) float32 to ``path``, and the grid to a .json file of the same name."""
    grid, unit = volume.required_grid, note.removeprefix("values in ")
    facts: dict[str, object] = {"axes": ["z", "y", "x"], "shape": volume.values.shape}
    facts |= {"voxel_size_mm": grid.voxel_size_mm, "first_centre_mm": grid.first_centre_mm, "values": unit}
    with written_beside(path.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        np.save(file, volume.values)  # an open file, since np.save adds a suffix to names


def write_zarr(path: Path, volume: Volume, scale: Hounsfield | None, unit: str = "values in 1/mm") -> None:
    """Writes OME-Zarr 0.5: a new folder of chunks at full and at repeatedly halved resolution, which viewers load as
    needed. Halving takes means of 2×2×2 voxels. Besides the volume (nz, ny, nx) in 1/mm, memory holds at most 128 slices.
    scale: writes Hounsfield units; None writes 1/mm, with the note ``unit``. Raises OutputError for a folder with files."""
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
                dimension_names=list("zyx"), config={"write_empty_chunks": True},  # else a lost chunk would read as zeros
            )  # fmt: skip
            for start in range(0, shape[0], _CHUNK):
                stop = min(start + _CHUNK, shape[0])
                slab = before[start * step[0] : stop * step[0]]
                if levels:  # voxels left over at the end are dropped
                    nz, ny, nx = np.array(slab.shape) // step * step
                    slab = block_means(slab[:nz, :ny, :nx], triple(step.tolist()))
                level[start:stop] = slab if levels or scale is None else scale.of(slab)
            levels.append({"path": name, "coordinateTransformations": _places(grid, factors)})
            step = np.where(np.array(shape) > 1, 2, 1)
            factors, before = factors * step, level
        axes = [{"name": axis, "type": "space", "unit": "millimeter"} for axis in "zyx"]
        note = {"values": unit if scale is None else scale.note}
        writer.write_multiscales_metadata(group, levels, axes=axes, name=path.name, metadata=note)


def _places(grid: Grid, factors: np.ndarray) -> list[dict[str, object]]:
    """Returns OME's scale and translation in mm for voxels that are ``factors`` (3,) times as large as the grid's."""
    first_mm = grid.first_centre_mm + (factors - 1) / 2 * grid.voxel_size_mm
    sizes = {"type": "scale", "scale": (factors * grid.voxel_size_mm).tolist()}
    return [sizes, {"type": "translation", "translation": first_mm.tolist()}]


def gaussians_of(volume: Volume, subject: str) -> dict[str, np.ndarray]:
    """Returns a volume's Gaussians, float32: mean (G, 3) and scale (G, 3) in mm, quaternion (G, 4) w x y z, density (G,) in
    1/mm. Raises InputError for a volume without Gaussians."""
    if volume.gaussians is None:
        remedy = "reconstruct with --method phyradgs or r2"
        raise InputError(f"{subject}:/entry/gaussians", "nothing there", "Gaussians", remedy)
    return vars(volume.gaussians)


def write_npz(path: Path, cloud: dict[str, np.ndarray]) -> None:
    """Writes the arrays of ``gaussians_of`` to one .npz file, by their names and without a pickle."""
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **cloud)  # type: ignore[arg-type]


def write_ply(path: Path, cloud: dict[str, np.ndarray]) -> None:
    """Writes the arrays of ``gaussians_of`` as binary PLY, a vertex per Gaussian. Comments in its header state the units."""
    columns = [cloud["mean"], cloud["scale"], cloud["quaternion"], cloud["density"][:, None]]
    rows = np.concatenate(columns, axis=1)
    properties = "".join(f"property float {name}\n" for name in _PLY_NAMES)
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        "comment radiative Gaussians: density * exp(-1/2 d^T (R diag(scale^2) R^T)^-1 d)\n"
        "comment x y z and scale in mm, rot quaternion w x y z, density in 1/mm; all linear\n"
        f"element vertex {len(rows)}\n{properties}end_header\n"
    )
    with written_beside(path) as temporary:
        temporary.write_bytes(head.encode("ascii") + np.ascontiguousarray(rows, "<f4").tobytes())
