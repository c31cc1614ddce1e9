"""From a volume file to a cloud of Gaussians in a file."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from phyradgs_cl import __version__
from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters import CLOUDS, export_stored, foreign_suffix, format_of
from phyradgs_cl.fields import Gaussians, Grid, triple
from phyradgs_cl.fields.gaussians import ROWS
from phyradgs_cl.fields.grid_choice import voxel_sides_mm
from phyradgs_cl.importers import load_attenuation
from phyradgs_cl.io import Volume, check_writable, hashing, write_volume
from phyradgs_cl.metrics import compare
from phyradgs_cl.reconstructors import ProgressReport, ignore_progress
from phyradgs_cl.reconstructors.splats.volume_fit import VolumeFitOptions, fit_volume
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.workflow.files import expecting, refuse_overwriting


def run_splat_fit(
    path: Path, output: Path, options: VolumeFitOptions, make_runtime: Callable[[], Runtime],
    report: ProgressReport = ignore_progress, *, seed: int = 0, voxel_mm: object = None,
) -> dict[str, object]:  # fmt: skip
    """Fits Gaussians to a volume file and writes them: a volume file with the Gaussians and their field, or a format of
    ``exporters.CLOUDS`` by the suffix. Returns psnr_db and ssim of the field against the volume, the number of Gaussians,
    seconds, and ``compression``: float32 voxels over float32 parameters. voxel_mm: sides (z, y, x) of the voxels of a volume
    without a scale. Raises InputError for volumes without a scale, and for outputs of another kind."""
    refuse_overwriting("-o", output, path)
    to = None if foreign_suffix(output) is None else format_of(output, "-o")
    expected = "a name that ends in .h5, .ply or .npz"
    if to is not None and to not in CLOUDS:
        remedy = f"write cloud.h5, then 'phyradgs export cloud.h5 --to {to}'"
        raise InputError("-o", f"output {output}, which has no place for Gaussians", expected, remedy)
    if to is None and output.suffix.lower() not in (".h5", ".hdf5"):
        raise InputError("-o", f"output {output}", expected)
    check_writable(output)
    with hashing(path) as hash_of, expecting(path, "volume", "plain-volume"):
        volume = load_attenuation(path)
        source = {"volume": str(path), "volume_sha256": hash_of()}
    rt = make_runtime()
    result = fit_volume(rt, volume.values, _grid_of(path, volume, voxel_mm), options, seed=seed, report=report)
    assert result.gaussians is not None
    cloud = Gaussians(**{name: values.astype(np.float32) for name, values in vars(result.gaussians).items()})
    metrics = compare(result.volume, volume.values)
    facts = {**result.facts, "compression": volume.values.size / (ROWS * cloud.count)}
    provenance = {**facts, **source, "program": f"phyradgs-cl {__version__}", "device": rt.device.name}
    with finish_despite_interrupt():
        if to is None:
            write_volume(output, result.volume, result.grid, provenance, cloud, metrics)
        else:
            export_stored(Volume(result.volume, result.grid, {}, cloud), to, output, str(path))
    return {**metrics, **{key: facts[key] for key in ("gaussians", "compression", "seconds")}, "output": str(output)}


def _grid_of(path: Path, volume: Volume, voxel_mm: object) -> Grid:
    if volume.grid is None:
        if voxel_mm is None:
            remedy = "say --voxel-mm and the sides of its voxels in mm"
            raise InputError(str(path), "voxels without a scale", "a volume with its grid", remedy)
        return Grid(triple(volume.values.shape), voxel_sides_mm("--voxel-mm", voxel_mm))
    if voxel_mm is not None:
        raise InputError("--voxel-mm", "given", f"a volume without a scale; {path} has one", "leave it out")
    return volume.grid
