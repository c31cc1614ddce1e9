"""Volumes in other programs' formats, with spacing, origin and directions: `export_volume`."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters import writers
from phyradgs_cl.exporters.dicom import DicomLabels, write_dicom
from phyradgs_cl.io import Volume, read_volume

__all__ = [
    "CLOUDS", "EXPORTS", "DicomLabels", "default_output", "export_stored", "export_volume", "foreign_suffix", "format_of",
]  # fmt: skip

VOXELS: dict[str, Callable[[Path, Volume, str], None]] = {
    "nii": writers.write_image,
    "mha": writers.write_image,
    "nrrd": writers.write_image,
    "tiff": writers.write_tiff,
    "npy": writers.write_npy,
}
CLOUDS = {"ply": writers.write_ply, "npz": writers.write_npz}
EXPORTS = (*VOXELS, "dicom", *CLOUDS)
_SUFFIXES = {"nii": (".nii", ".nii.gz"), "tiff": (".tif", ".tiff"), "dicom": ()}


def export_volume(
    path: str | Path, to: str, output: str | Path | None = None, mu_water_per_mm: float | None = None,
    labels: DicomLabels | None = None,
) -> Path:  # fmt: skip
    """Writes a volume file in another format, whole or not at all, and returns the path of the output. ``to``: one of
    ``EXPORTS``; ply and npz take the Gaussians, all others the voxels. ``output``: a file, or a folder for dicom; None takes
    the folder of ``path``. ``mu_water_per_mm``: attenuation of water; the values are then Hounsfield units. ``labels``:
    patient, study and series, for dicom alone. InputError: an unknown format, a damaged volume or one without Gaussians, a
    suffix of another format, labels with another format. OutputError: the output cannot be written."""
    checks.one_of("--to", to, EXPORTS)
    path = Path(path)
    target = default_output(path, to) if output is None else Path(output)
    suffixes = _suffixes(to)  # programs go by the suffix
    if suffixes and not target.name.lower().endswith(suffixes):
        raise InputError(f"output of --to {to}", str(target), f"a name that ends in {' or '.join(suffixes)}")
    if target.resolve() == path.resolve():
        raise InputError("output", f"the input {path} itself", "another name")
    if to in CLOUDS and mu_water_per_mm is not None:
        raise InputError("--mu-water-per-mm", f"with --to {to}", "voxels", "Gaussians stay in 1/mm")
    if to != "dicom" and labels is not None and labels.given:
        raise InputError(f"--{next(iter(labels.given))}", f"with --to {to}", "--to dicom", "leave it out")
    export_stored(read_volume(path), to, target, str(path), mu_water_per_mm, labels)
    return target


def export_stored(
    volume: Volume, to: str, target: Path, subject: str, mu_water_per_mm: float | None = None,
    labels: DicomLabels | None = None,
) -> None:  # fmt: skip
    """Writes a volume as ``export_volume`` does; ``subject`` names it in messages."""
    if to in CLOUDS:
        CLOUDS[to](target, writers.gaussians_of(volume, subject))
        return
    if volume.grid is None:
        raise InputError(subject, "values without voxel sizes", "a volume with its grid", "see 'phyradgs info'")
    values, unit = np.ascontiguousarray(volume.values, np.float32), "1/mm"
    if mu_water_per_mm is not None:
        values, unit = writers.hounsfield(values, mu_water_per_mm), "HU"
    volume = replace(volume, values=values)
    if to == "dicom":
        write_dicom(target, volume, unit, labels or DicomLabels())
    else:
        VOXELS[to](target, volume, unit)


def foreign_suffix(output: str | Path) -> str | None:
    """Returns the suffix of another program's format, or None. A file with such a name must not hold HDF5."""
    suffixes = (*(suffix for to in EXPORTS for suffix in _suffixes(to)), ".mhd", ".dcm", ".png")
    return next((suffix for suffix in suffixes if Path(output).name.lower().endswith(suffix)), None)


def default_output(path: Path, to: str) -> Path:
    """Returns the volume's path with the suffix of the format; for DICOM a folder."""
    return path.with_name(f"{path.stem}_dicom") if to == "dicom" else path.with_suffix(_suffixes(to)[0])


def format_of(output: str | Path | None, subject: str = "--to") -> str:
    """Returns the one of ``EXPORTS`` that the suffix of an output means; InputError, with the suffixes, for any other."""
    for to in EXPORTS:
        if output is not None and _suffixes(to) and Path(output).name.lower().endswith(_suffixes(to)):
            return to
    suffixes = ", ".join(suffix for to in EXPORTS for suffix in _suffixes(to))
    found = "neither a format nor an output" if output is None else f"output {output}"
    remedy = "use such a suffix, or give --to dicom" if subject == "--to" else "or .h5, which holds everything"
    raise InputError(subject, found, f"a suffix of {suffixes}", remedy)


def _suffixes(to: str) -> tuple[str, ...]:
    return _SUFFIXES.get(to, (f".{to}",))
