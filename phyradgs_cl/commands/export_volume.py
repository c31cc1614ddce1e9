"""export: a volume for other programs."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from phyradgs_cl.commands.console import say
from phyradgs_cl.commands.files import file_argument, file_option
from phyradgs_cl.exporters import CLOUDS, EXPORTS, export_volume, format_of
from phyradgs_cl.reconstructors.interrupt import finish_despite_interrupt
from phyradgs_cl.workflow.files import expecting

EXAMPLE = "Example: phyradgs export volume.h5 -o volume.nii --mu-water-per-mm 0.0195"


def export_command(
    volume: Annotated[Path, file_argument("VOLUME", "Volume file.")],
    output: Annotated[
        Path | None,
        file_option(
            "--output",
            "-o",
            help="File to write, or for dicom a new folder; nii.gz is compressed.",
            show_default="VOLUME with the format's suffix",
        ),
    ] = None,
    to: Annotated[
        Literal[EXPORTS] | None,  # type: ignore[valid-type]
        typer.Option(
            "--to",
            help="nii, mha, nrrd, tiff, npy, dicom (a folder): the voxels; ply, npz: the Gaussians.",
            show_default="what the output's suffix says",
        ),
    ] = None,
    mu_water_per_mm: Annotated[
        float | None,
        typer.Option(
            help="Attenuation of water in 1/mm: writes Hounsfield units.", show_default="none: values in 1/mm"
        ),
    ] = None,
) -> None:
    """Export a volume, upright and to scale, for 3D Slicer, ITK-SNAP, ImageJ, napari and others."""
    form = to or format_of(output)
    with finish_despite_interrupt(), expecting(volume, "volume"):
        written = export_volume(volume, form, output, mu_water_per_mm)
    unit = "" if form in CLOUDS else ", HU" if mu_water_per_mm is not None else ", 1/mm"
    say(f"{written}: {form}{unit}")
