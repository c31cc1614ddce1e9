"""From two volumes to numbers and a picture."""

import logging
import math
from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.io import check_writable, written_beside
from phyradgs_cl.io.volume import interruption
from phyradgs_cl.metrics import compare, resampled, shared_slices, slices_png
from phyradgs_cl.reconstructors.interrupt import finish_despite_interrupt
from phyradgs_cl.text import plain_text
from phyradgs_cl.workflow.files import load_reference, load_result, refuse_overwriting

log = logging.getLogger(__name__)


@np.errstate(all="ignore")
def run_evaluation(volume_path: Path, reference_path: Path, picture: Path) -> dict[str, object]:
    """Compares a volume with a scan's reference or another volume, onto whose voxels within its box it is resampled, and
    writes the picture of slices; values without a grid are compared voxel by voxel."""
    refuse_overwriting("--picture", picture, volume_path, reference_path)
    if picture.suffix.lower() != ".png":
        raise InputError("--picture", str(picture), "a file name that ends in .png")
    check_writable(picture)
    volume, grid, provenance = load_result(volume_path)
    reference, wanted = load_reference(reference_path)
    told: dict[str, object] = {}
    if grid is not None and wanted is not None and not grid.is_close(wanted):
        volume, reference, told = _on_shared_voxels(volume_path, reference_path, (volume, grid), (reference, wanted))
    if reference.shape != volume.shape:
        raise InputError(str(reference_path), f"shape {reference.shape}", f"shape {volume.shape} of {volume_path}")
    metrics = compare(volume, reference)
    title = f"{provenance.get('method', 'volume')}: {volume_path.name}"
    with finish_despite_interrupt(), written_beside(picture) as temporary:
        try:
            slices_png(temporary, volume, reference, title)
        except OutputError as error:  # names the temporary file; what the disk says is behind it
            raise error.__cause__ or error from None
    known: dict[str, object] = {key: provenance[key] for key in ("method", "seconds", "gaussians") if key in provenance}
    files = {"volume": str(volume_path), "reference": str(reference_path), "picture": str(picture)}
    return {**metrics, **known, **interruption(provenance), **told, **files}


def _on_shared_voxels(
    volume_path: Path, reference_path: Path, result: tuple[np.ndarray, Grid], truth: tuple[np.ndarray, Grid]
) -> tuple[np.ndarray, np.ndarray, dict[str, object]]:
    """The result and the truth on those voxels of the truth's that lie in the result's box, and what to say of that."""
    (volume, grid), (reference, wanted) = result, truth
    shared = shared_slices(wanted, grid)
    if shared is None:
        found = f"{_place(grid)}, which has no voxel of the reference, {_place(wanted)}"
        raise InputError(str(volume_path), found, "volumes in one place")
    part = reference[shared]
    share = part.size / reference.size
    if not part.max() > 0:
        found = f"nothing in the {100 * share:.3g} % of it that lie in {volume_path}"
        raise InputError(str(reference_path), found, "an object in the part that is compared")
    told: dict[str, object] = {"share_of_reference_covered": share}
    if grid.slices_in(wanted) == shared:
        found = "%s: compared with its part of the reference, %.3g %% of the voxels"
        log.warning(found, plain_text(str(volume_path)), 100 * share)
        return volume, part, told
    volume, _ = resampled(volume, grid, wanted.part(triple(one.start for one in shared), triple(part.shape)))
    where = f"from {_place(grid)} onto the reference's {_place(wanted)}"
    rest = "" if share == 1 else f"; compared on the {100 * share:.3g} % of those that lie in the volume"
    log.warning("%s: resampled (linear) %s%s", plain_text(str(volume_path)), where, rest)
    return volume, part, {"resampled": where, **told}


def _place(grid: Grid) -> str:
    """A grid in a few words, x y z as everywhere where people read of sizes."""
    counts, sizes, offsets = (v[::-1] for v in (grid.shape, grid.voxel_size_mm, grid.offset_mm))
    digits = 3 - math.floor(math.log10(min(sizes)))  # a thousandth of a voxel is no offset
    words = f"{'×'.join(map(str, counts))} voxels (x y z) of {'×'.join(f'{s:.4g}' for s in sizes)} mm"
    return f"{words} about ({', '.join(f'{round(o, digits) + 0.0:g}' for o in offsets)}) mm"
