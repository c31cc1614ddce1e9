"""Volumes in other programs' formats, with spacing, origin and directions; `export_volume` is the door."""

from collections.abc import Callable
from pathlib import Path

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters.dicom import DicomLabels, write_dicom
from phyradgs_cl.exporters.gaussians import gaussians_of, write_npz, write_ply
from phyradgs_cl.exporters.meta_image import write_meta_image
from phyradgs_cl.exporters.nifti import write_nifti
from phyradgs_cl.exporters.npy import write_npy
from phyradgs_cl.exporters.nrrd import write_nrrd
from phyradgs_cl.exporters.placed import Placed, hounsfield, placed
from phyradgs_cl.exporters.tiff import write_tiff
from phyradgs_cl.io import StoredVolume, read_volume

__all__ = [
    "CLOUDS", "EXPORTS", "DicomLabels", "Placed", "default_output", "export_stored", "export_volume", "foreign_suffix",
    "format_of", "hounsfield", "placed",
]  # fmt: skip

VOXELS: dict[str, Callable[[Path, Placed], None]] = {
    "nii": write_nifti,
    "mha": write_meta_image,
    "nrrd": write_nrrd,
    "tiff": write_tiff,
    "npy": write_npy,
    "dicom": write_dicom,
}
CLOUDS = {"ply": write_ply, "npz": write_npz}
EXPORTS = (*VOXELS, *CLOUDS)
_SUFFIXES = {"nii": (".nii", ".nii.gz"), "tiff": (".tif", ".tiff"), "dicom": ()}


def export_volume(
    path: str | Path, to: str, output: str | Path | None = None, mu_water_per_mm: float | None = None,
    labels: DicomLabels | None = None,
) -> Path:  # fmt: skip
    """Write a volume file in another format, whole or not at all; returns what was written.

    ``to``: one of ``EXPORTS``; ply and npz take the Gaussians, all others the voxels. ``output``: file, or folder for dicom;
    None puts it beside ``path``. ``mu_water_per_mm``: water's attenuation; the values are then Hounsfield units. ``labels``:
    patient, study and series, which dicom alone takes. InputError: no such format, a volume that is damaged or has no
    Gaussians, a name that does not fit, labels with another format. OutputError: it cannot be written.
    """
    checks.one_of("--to", to, EXPORTS)
    path = Path(path)
    target = default_output(path, to) if output is None else Path(output)
    _check_name(target, to, path)
    if to in CLOUDS and mu_water_per_mm is not None:
        raise InputError("--mu-water-per-mm", f"with --to {to}", "voxels", "Gaussians stay in 1/mm")
    if to != "dicom" and labels is not None and labels.given:
        raise InputError(f"--{next(iter(labels.given))}", f"with --to {to}", "--to dicom", "leave it out")
    export_stored(read_volume(path), to, target, str(path), mu_water_per_mm, labels)
    return target


def export_stored(
    stored: StoredVolume, to: str, target: Path, subject: str, mu_water_per_mm: float | None = None,
    labels: DicomLabels | None = None,
) -> None:  # fmt: skip
    """Write a volume as ``export_volume`` does; ``subject``: where it comes from."""
    if to in CLOUDS:
        CLOUDS[to](target, gaussians_of(stored, subject))
    elif to == "dicom":
        write_dicom(target, placed(stored, mu_water_per_mm), labels)
    else:
        VOXELS[to](target, placed(stored, mu_water_per_mm))


def foreign_suffix(output: str | Path) -> str | None:
    """The suffix of another program's format that a name ends in: what is written under it must not be HDF5."""
    known = (*(suffix for to in EXPORTS for suffix in _suffixes(to)), ".mhd", ".dcm", ".png")
    return next((suffix for suffix in known if Path(output).name.lower().endswith(suffix)), None)


def default_output(path: Path, to: str) -> Path:
    """The volume's name with the format's suffix; for DICOM a folder."""
    return path.with_name(f"{path.stem}_dicom") if to == "dicom" else path.with_suffix(_suffixes(to)[0])


def format_of(output: str | Path | None, subject: str = "--to") -> str:
    """The one of ``EXPORTS`` whose suffix an output's name has; InputError, which lists them, for any other."""
    for to in EXPORTS:
        if output is not None and _suffixes(to) and Path(output).name.lower().endswith(_suffixes(to)):
            return to
    known = ", ".join(suffix for to in EXPORTS for suffix in _suffixes(to))
    found = "neither a format nor an output" if output is None else f"output {output}"
    remedy = "name the output so, or say --to, for dicom always" if subject == "--to" else "or .h5, which holds everything"
    raise InputError(subject, found, f"a suffix of {known}", remedy)


def _suffixes(to: str) -> tuple[str, ...]:
    return _SUFFIXES.get(to, (f".{to}",))


def _check_name(target: Path, to: str, source: Path) -> None:
    """Other programs go by the suffix, so a wrong one is refused."""
    suffixes = _suffixes(to)
    if suffixes and not target.name.lower().endswith(suffixes):
        raise InputError(f"output of --to {to}", str(target), f"a name that ends in {' or '.join(suffixes)}")
    if target.resolve() == source.resolve():
        raise InputError("output", f"the input {source} itself", "another name")
