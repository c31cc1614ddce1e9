"""From two volumes to numbers and a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import (
    check_writable,
    read_volume,
    written_beside,
)
from phyradgs_cl.io.volume_file import interruption
from phyradgs_cl.metrics import compare, slices_png
from phyradgs_cl.reconstructors.interrupt import (
    finish_despite_interrupt,
)
from phyradgs_cl.workflow.files import expecting, load_reference, refuse_overwriting


@np.errstate(all="ignore")
def run_evaluation(volume_path: Path, reference_path: Path, picture: Path) -> dict[str, object]:
    """Compares a volume with a scan's reference or another volume and writes the picture of slices."""
    refuse_overwriting("--picture", picture, volume_path, reference_path)
    if picture.suffix.lower() != ".png":
        raise InputError("--picture", str(picture), "a file name that ends in .png")
    check_writable(picture)
    with expecting(volume_path, "volume"):
        stored = read_volume(volume_path)
    reference, grid = load_reference(reference_path)
    if grid is not None and not _same_grid(grid, stored.grid):
        raise InputError(str(reference_path), f"the grid {grid}", f"that of {volume_path}: {stored.grid}")
    if reference.shape != stored.volume.shape:
        raise InputError(
            str(reference_path), f"shape {reference.shape}", f"shape {stored.volume.shape} of {volume_path}"
        )
    metrics = compare(stored.volume, reference)
    title = f"{stored.provenance.get('method', 'volume')}: {volume_path.name}"
    with finish_despite_interrupt():
        _write_picture(picture, stored.volume, reference, title)
    known = {
        key: stored.provenance[key] for key in ("method", "seconds", "gaussians") if key in stored.provenance
    }
    return {
        **metrics,
        **known,
        **interruption(stored.provenance),
        "volume": str(volume_path),
        "reference": str(reference_path),
        "picture": str(picture),
    }


def _write_picture(picture: Path, volume: np.ndarray, reference: np.ndarray, title: str) -> None:
    """The picture, whole or not at all."""
    with written_beside(picture) as temporary:
        try:
            slices_png(temporary, volume, reference, title)
        except OutputError as error:  # names the temporary file; what the disk says is behind it
            raise error.__cause__ or error from None


def _same_grid(a: Grid, b: Grid) -> bool:
    close = np.allclose(a.voxel_size_mm, b.voxel_size_mm, rtol=1e-5)
    return a.shape == b.shape and close and np.allclose(a.offset_mm, b.offset_mm, atol=1e-5 * max(a.size_mm))
