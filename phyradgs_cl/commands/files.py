"""The commands info and export: print a file's contents, and write a volume for other programs."""

import textwrap
from pathlib import Path
from typing import Annotated, Any, Literal

from phyradgs_cl import exporters
from phyradgs_cl.commands.console import (
    AsJson,
    file_argument,
    file_option,
    numbers,
    option,
    pair_option,
    say,
    say_json,
)
from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters.dicom import DicomLabels
from phyradgs_cl.fields import Hounsfield
from phyradgs_cl.io import Volume, holds_deformation, read_deformation, read_states
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.text import value_text
from phyradgs_cl.workflow.files import expecting, summary

EXAMPLES = {
    "info": "Example: phyradgs info scan.h5",
    "export": "Example: phyradgs export volume.h5 -o volume.nii --hu",
}
GROUPS = {"export": {
    "Basics": ("output", "to", "doubt"),
    "Hounsfield units": ("hu", "air_mm", "water_mm", "insert_hu", "mu_water_per_mm"),
    "Objects that move": ("object_motion", "states", "during"),
    "DICOM": ("patient", "title", "description", "date"),
}}
_MOTION = "Deformation of the object: the volume is written at several states."
_STATES = "Number of states, at the middles of equal parts of the time; nii has them in one file."
_PAIR = pair_option("START,STOP in s", "8,12", "START,STOP")
_PEAK, _BOX = "the volume's own peak", "Z0,Z1,Y0,Y1,X0,X1"
# Cuts a value into lines; paths stay in one piece.
_LINES = textwrap.TextWrapper(100, max_lines=6, placeholder=" … (--json)", break_long_words=False, break_on_hyphens=False)
_OUTPUT = "File to write, or for dicom and zarr a new folder; nii.gz is compressed."
_BESIDE = "VOLUME with the format's suffix"
_TO = f"{', '.join(exporters.VOXELS)}, zarr and dicom (folders): the voxels; {', '.join(exporters.CLOUDS)}: the Gaussians."
_WATER = "Attenuation of water in 1/mm; the values are then Hounsfield units, with air at 0."
_HU = "Hounsfield units by the volume's own scale, else fitted to air and water. An output .h5 keeps 1/mm and the scale."
_AIR = "Box of air, for Hounsfield units."
_WATER_BOX = "Box of water, or of the insert, for Hounsfield units."
_DOUBT = "The error bars σ of 'reconstruct --doubt' in 1/mm; with --to, by default to VOLUME.doubt with the suffix."
_INSERT = "HU of the second point, where it is not water."


def info_command(
    file: Annotated[Path, file_argument("FILE", "Scan or volume file, or a volume as mha, nii, nrrd, npy, tiff, zarr.")],
    as_json: AsJson = False,
) -> None:
    """Print the contents of a scan or volume file."""
    facts = summary(file)
    if as_json:
        say_json(facts)
        return
    for key, value in facts.items():
        if value is not None:
            say(f"{key.replace('_', ' '):24s} " + f"\n{'':25s}".join(_LINES.wrap(value_text(value))))


def export_command(
    volume: Annotated[Path, file_argument("VOLUME", "Volume file.")],
    output: Annotated[Path | None, file_option(_OUTPUT, "--output", "-o", default=_BESIDE)] = None,
    to: Annotated[Literal[exporters.EXPORTS] | None, option(_TO, "by the output's suffix", "--to")] = None,  # type: ignore[valid-type]
    doubt: Annotated[bool, option(_DOUBT, True, "--doubt")] = False,
    hu: Annotated[bool, option(_HU, True, "--hu")] = False,
    air_mm: Annotated[Any, option(_AIR, _PEAK, parser=numbers, metavar=_BOX)] = None,
    water_mm: Annotated[Any, option(_WATER_BOX, _PEAK, parser=numbers, metavar=_BOX)] = None,
    insert_hu: Annotated[float, option(_INSERT)] = 0.0,
    mu_water_per_mm: Annotated[float | None, option(_WATER, "none: values in 1/mm")] = None,
    object_motion: Annotated[Path | None, file_option(_MOTION, "--object-motion")] = None,
    states: Annotated[int | None, option(_STATES, "10")] = None,
    during: Annotated[Any, _PAIR("--during", "Time that the states cover, s.", "the motion's")] = None,
    patient: Annotated[str | None, option("The patient's name and ID, as Family^Given.", metavar="NAME")] = None,
    title: Annotated[str | None, option("The study's description.", metavar="TEXT")] = None,
    description: Annotated[str | None, option("The series' description.", "the unit", metavar="TEXT")] = None,
    date: Annotated[str | None, option("The study's date.", metavar="YYYY-MM-DD")] = None,
) -> None:
    """Export a volume, upright and to scale, for 3D Slicer, ITK-SNAP, ImageJ, napari and others."""
    form, labels = to or exporters.format_of(output), DicomLabels(patient, title, description, date)
    moves = object_motion is not None or states is not None or during is not None
    if doubt and moves:
        remedy = "leave --object-motion, --states and --during out"
        raise InputError("--doubt", "given with an object that moves", "one volume, which alone has error bars", remedy)
    scales: list[Hounsfield | None] = []
    hu = hu or air_mm is not None or water_mm is not None or insert_hu != 0

    def scale_of(stored: Volume) -> Hounsfield | None:
        scales.append(exporters.hu_scale(stored, air_mm, water_mm, insert_hu))
        return scales[-1]

    scaling = scale_of if hu else None
    with finish_despite_interrupt(), expecting(volume, "volume"):
        if not moves:
            written: object = exporters.export_volume(volume, form, output, mu_water_per_mm, labels, scaling, doubt)
        else:
            has_field = object_motion is not None or holds_deformation(volume)
            field = read_deformation(object_motion or volume) if has_field else None
            if (motion := field or read_states(volume)) is None:
                expected = "--object-motion FILE with it, or a volume of --method moving or changing"
                raise InputError("--during" if states is None else "--states", "no motion", expected)
            times_s = exporters.state_times_s(motion, 10 if states is None else states, during)
            paths = exporters.export_states(volume, field, times_s, form, output, mu_water_per_mm, labels, scaling)
            written = paths[0] if len(paths) == 1 else f"{paths[0]} … {paths[-1]}"
    is_hu = form != exporters.OWN and (hu or mu_water_per_mm is not None)
    unit = "" if form in exporters.CLOUDS else ", HU" if is_hu else ", 1/mm"
    moving = "" if not moves else f", {len(times_s)} states from {times_s[0]:.4g} to {times_s[-1]:.4g} s"
    say(f"{written}: {form}{', error bars' if doubt else ''}{unit}{moving}")
    if scales and scales[0] is not None:
        say(f"Hounsfield units: {scales[0].line}")
