"""export: a volume for other programs."""

from pathlib import Path
from typing import Annotated, Literal

from phyradgs_cl.commands.console import say
from phyradgs_cl.commands.files import file_argument, file_option, option
from phyradgs_cl.exporters import CLOUDS, EXPORTS, DicomLabels, export_volume, format_of
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.workflow.files import expecting

EXAMPLE = "Example: phyradgs export volume.h5 -o volume.nii --mu-water-per-mm 0.0195"
_OUTPUT = "File to write, or for dicom a new folder; nii.gz is compressed."
_USUAL = "VOLUME with the format's suffix"
_TO = "nii, mha, nrrd, tiff, npy, dicom (a folder): the voxels; ply, npz: the Gaussians."
_WATER = "Attenuation of water in 1/mm: writes Hounsfield units."


def export_command(
    volume: Annotated[Path, file_argument("VOLUME", "Volume file.")],
    output: Annotated[Path | None, file_option(_OUTPUT, "--output", "-o", default=_USUAL)] = None,
    to: Annotated[
        Literal[EXPORTS] | None,  # type: ignore[valid-type]
        option(_TO, "what the output's suffix says", "--to"),
    ] = None,
    mu_water_per_mm: Annotated[float | None, option(_WATER, "none: values in 1/mm")] = None,
    patient: Annotated[str | None, option("DICOM: the patient's name and ID, as Family^Given.", metavar="NAME")] = None,
    title: Annotated[str | None, option("DICOM: the study's description.", metavar="TEXT")] = None,
    description: Annotated[str | None, option("DICOM: the series' description.", "the unit", metavar="TEXT")] = None,
    date: Annotated[str | None, option("DICOM: the study's date.", metavar="YYYY-MM-DD")] = None,
) -> None:
    """Export a volume, upright and to scale, for 3D Slicer, ITK-SNAP, ImageJ, napari and others."""
    form, labels = to or format_of(output), DicomLabels(patient, title, description, date)
    with finish_despite_interrupt(), expecting(volume, "volume"):
        written = export_volume(volume, form, output, mu_water_per_mm, labels)
    unit = "" if form in CLOUDS else ", HU" if mu_water_per_mm is not None else ", 1/mm"
    say(f"{written}: {form}{unit}")
