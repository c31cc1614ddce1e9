"""Compares a volume with a reference: computes metrics, and draws slices of both."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.fields import Grid, MovingTruth, triple
from phyradgs_cl.fields.grid_choice import voxel_sides_mm
from phyradgs_cl.io import Volume, read_deformation, written_beside
from phyradgs_cl.io.attenuation import attenuation_of, words_of_hu
from phyradgs_cl.io.volume import interruption
from phyradgs_cl.metrics import METRICS, VOXEL_BY_VOXEL, Aligned, aligned, compare, in_words, overlap
from phyradgs_cl.metrics.coverage import coverage, reliability_png
from phyradgs_cl.metrics.quality import edge_points_mm, motion_error_mm, slices_png
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.text import plain_text
from phyradgs_cl.workflow.files import check_picture, load_reference, load_result

log = logging.getLogger(__name__)
_LITTLE = 0.5 - 1e-6  # if two boxes share less than this fraction of one of them, a size or offset is often wrong
# Volumes that overlap little get a warning if they correlate less than this: with wrong sizes 0.6 at most, with right ones
# 0.55 to 0.9.
_ALIKE = 0.65


@np.errstate(all="ignore")
def run_evaluation(
    volume_path: Path, reference_path: Path, picture: Path, reference_voxel_mm: object = None,
    object_motion: Path | None = None, reference_of_rtk: bool = False, mu_water_per_mm: float | None = None,
) -> dict[str, object]:
    """Compares a volume with a scan's true volume or another volume, on the grid of ``metrics.aligned``. Writes a picture of
    slices and, for error bars, computes their coverage and draws a curve. A volume without voxel sizes is compared voxel by
    voxel.

    reference_voxel_mm: voxel sides of a reference that does not state them, one length or (z, y, x).
    object_motion: the file of a deformation, which moves the volume to the time of each true volume of a scan; None takes
    the volume's own, if it has one. reference_of_rtk: the reference has RTK's axes. mu_water_per_mm: water's attenuation,
    for files in Hounsfield units that do not state it. Raises InputError for impossible sides, files that do not fit each
    other, and water's attenuation for files in 1/mm."""
    check_picture("--picture", picture, volume_path, reference_path, object_motion)
    field = None if object_motion is None else read_deformation(object_motion)
    result = attenuation_of(str(volume_path), load_result(volume_path, mu_water_per_mm))
    stored, moving = load_reference(reference_path, mu_water_per_mm)
    stored = attenuation_of(str(reference_path), stored)
    converted = words_of_hu({volume_path: result, reference_path: stored}, mu_water_per_mm)
    if field is not None and (moving is None or result.grid is None):
        expected = "a scan simulated with --motion-of-object, and a volume with a scale"
        raise InputError("--object-motion", "no true states to compare with", expected, "leave it out")
    if reference_of_rtk:
        stored, moving = _with_our_axes(stored), None
    if field is not None:
        result = result.moved_by(field, str(volume_path))
    volume, grid, provenance = result.values, result.grid, result.provenance
    reference, stored_grid = stored.values, stored.grid
    how, share = f"{VOXEL_BY_VOXEL}, as {plain_text(volume_path.name)} has no scale", 1.0
    if grid is not None:
        truth = reference, _grid_of(reference_path, reference, stored_grid, reference_voxel_mm, volume_path)
        pair = _on_one_grid(volume_path, reference_path, (volume, grid), truth)
        volume, reference, how, share = pair.volume, pair.reference, pair.how, pair.share
    if reference.shape != volume.shape:
        raise InputError(str(reference_path), f"shape {reference.shape}", f"shape {volume.shape} of {volume_path}")
    metrics: dict[str, object] = {**compare(volume, reference)}
    if result.doubt is not None and grid is not None:
        facts, curve = provenance.get("doubt"), picture.with_name(f"{picture.stem}.doubt.png")
        stated = facts.get("multiple_95") if isinstance(facts, Mapping) else None
        multiple_95 = stated if isinstance(stated, float) else 1.96  # 95 % of a normal distribution lie within 1.96 σ
        bar = volume if (of_bars := aligned(result.doubt, grid, *truth)) is None else of_bars.volume
        with finish_despite_interrupt(), written_beside(curve) as temporary:
            reliability_png(temporary, bar, volume, reference, multiple_95)
        metrics |= {**coverage(bar, volume, reference, multiple_95), "reliability": str(curve)}
    states = {}
    if moving is not None and grid is not None and stored_grid is not None:
        if result.deformation is None and "object_motion" in provenance:
            text = "%s was reconstructed with --object-motion %s: add it here, else the volume is compared as if it rested"
            log.warning(text, volume_path, plain_text(str(provenance["object_motion"])))
        states = compared_states(result, moving, stored_grid)
    title = f"{provenance.get('method', 'volume')}: {volume_path.name}"
    with finish_despite_interrupt(), written_beside(picture) as temporary:
        try:
            slices_png(temporary, volume, reference, title)
        except OutputError as error:  # raises its cause, so that the message names the picture, not the temporary file
            raise error.__cause__ or error from None
    known: dict[str, object] = {key: provenance[key] for key in ("method", "seconds", "gaussians") if key in provenance}
    files = {"volume": str(volume_path), "reference": str(reference_path), "picture": str(picture)}
    compared: dict[str, object] = {"compared": how + converted, "share_of_reference_covered": share}
    return {**metrics, **states, **known, **interruption(provenance), **compared, **files}


def compared_states(result: Volume, truth: MovingTruth, truth_grid: Grid) -> dict[str, Any]:
    """Returns PSNR and SSIM at each time of ``truth``, and their means. If the deformations of result and truth are known,
    adds the mean and the 95th percentile of the motion's error in mm. Raises InputError for boxes that do not overlap."""
    grid, field = result.required_grid, result.deformation
    rows: list[dict[str, float]] = []
    for time_s, state in zip(truth.times_s, truth.volumes, strict=True):
        pair = aligned(result.at(float(time_s)), grid, state, truth_grid)
        if pair is None or not pair.reference.max() > 0:
            found = "nothing of the object in the part that is compared"
            raise InputError(f"state at {time_s:.4g} s", found, "volumes in one place")
        rows.append({"time_s": float(time_s), **compare(pair.volume, pair.reference)})
    facts = {"states": rows, **{f"mean_{name}": float(np.mean([row[name] for row in rows])) for name in METRICS}}
    if field is not None and truth.deformation is not None and len(rows) > 1:
        points_mm = edge_points_mm(truth.volumes[0], truth_grid)
        try:
            mean_mm, high_mm = motion_error_mm(field, truth.deformation, points_mm, truth.times_s)
            facts |= {"mean_motion_error_mm": mean_mm, "p95_motion_error_mm": high_mm}
        except InputError as error:  # the deformation has no inverse; other metrics need none
            log.warning("no error of the motion: %s", error)
    return facts


def _with_our_axes(volume: Volume) -> Volume:
    """Reorders a volume of RTK, whose axes x, y, z are this package's y, z, x."""
    order, grid = [1, 2, 0], volume.grid  # the index in RTK's (z, y, x) of each of our axes (z, y, x)
    if grid is not None:
        shape, size_mm, offset_mm = (np.array(zyx)[order] for zyx in (grid.shape, grid.voxel_size_mm, grid.offset_mm))
        grid = Grid(triple(shape.tolist()), triple(size_mm.tolist()), triple(offset_mm.tolist()))
    return Volume(volume.values.transpose(order), grid)


def _grid_of(path: Path, reference: np.ndarray, grid: Grid | None, voxel_mm: object, volume_path: Path) -> Grid:
    """Returns the reference's ``grid`` or, without one, a grid with voxels of ``voxel_mm``, centred on the axis. Raises
    InputError if both or none of the two are given."""
    if voxel_mm is not None:
        if grid is not None:
            expected = f"a reference without a scale; {path} has {in_words(grid)}"
            raise InputError("--reference-voxel-mm", checks.short_repr(voxel_mm), expected, "leave it out")
        return Grid(triple(reference.shape), voxel_sides_mm("--reference-voxel-mm", voxel_mm))
    if grid is None:
        found, expected = "voxels without a scale", f"a reference that says where they lie, as {volume_path} does"
        remedy = "say --reference-voxel-mm and the side of its voxels in mm, if it is centred on the axis"
        raise InputError(str(path), found, expected, remedy)
    return grid


def _on_one_grid(
    volume_path: Path, reference_path: Path, result: tuple[np.ndarray, Grid], truth: tuple[np.ndarray, Grid]
) -> Aligned:
    """Returns both volumes on one grid. Raises InputError if they have no object in common, and warns of little overlap."""
    pair = aligned(*result, *truth)
    if pair is None:
        found = f"{in_words(result[1])}, which has no voxel of the reference, {in_words(truth[1])}"
        raise InputError(str(volume_path), found, "volumes in one place")
    if not pair.reference.max() > 0:
        found = f"nothing in the {100 * pair.share:.3g} % of it that lie in {volume_path}"
        raise InputError(str(reference_path), found, "an object in the part that is compared")
    of_volume, of_reference = overlap(result[1], truth[1])
    is_little = min(of_volume, of_reference) < _LITTLE and pair.grid != result[1]
    if is_little and not np.corrcoef(pair.volume.ravel(), pair.reference.ravel())[0, 1] >= _ALIKE:
        text = "%s and %s share %.3g %% of the first box and %.3g %% of the second: unless one is a part on purpose, "
        text += "correct voxel size or offset"
        log.warning(text, volume_path, reference_path, 100 * of_volume, 100 * of_reference)
    return pair
