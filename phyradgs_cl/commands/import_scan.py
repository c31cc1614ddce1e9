"""The command import: turns a scan of another program into a scan file."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.scan import APPLIED
from phyradgs_cl.commands.console import file_argument, file_option, option, remark, say
from phyradgs_cl.commands.options import lengths, of_fields, pitches, with_options
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import GridChoice
from phyradgs_cl.importers import FORMATS, ImportOptions, import_scan, recognise
from phyradgs_cl.importers.formats.tiff_folder import TEMPLATE
from phyradgs_cl.importers.frames import TAKEN
from phyradgs_cl.importers.options import option_name
from phyradgs_cl.io import file_kind, only_run, refuse_overwriting, write_scan
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.workflow.files import check_output

EXAMPLES = {
    "import": (
        "Example: phyradgs import chest_50.pickle -o scan.h5\n\n"
        "Example: phyradgs import scan.xml -o scan.h5 --fps 15 --exposure-ms 60 --readout-ms 62 --first top\n\n"
        "Example: phyradgs import tiffs --template > tiffs/scan.toml"
    )
}

FormatName = Literal[tuple(FORMATS)]  # type: ignore[valid-type]
_TEMPLATE = "Print a TOML to fill in for a folder of TIFFs, and write nothing."
GROUPS = {"import": {
    "Basics": (
        "output", "template", "form", "source_to_axis_mm", "source_to_detector_mm", "pixel_size_mm", "fps",
        "exposure_ms", "readout_ms", "first",
    ),
    "Geometry": ("detector_offset_mm", "unit_mm", "rotates"),
    "Timing": ("exposure_s", "angles", "angle_at", "detector_model"),
    "Pixels": ("frames", "quantity", "flats", "flat_value", "row_0", "column_0", "part", "first_view"),
    "HDF5": ("entry", "at", "linked_folder"),
    "Volume": ("size", "voxel_mm", "roi_mm"),
}}
_OF_SCAN = of_fields(ImportOptions, pixel_size_mm=pitches, detector_offset_mm=lengths)
_OF_GRID = {name: known for name, known in of_fields(GridChoice).items() if name != "margin_mm"}


@with_options("grid", _OF_GRID, lambda given: GridChoice(**given))
@with_options("options", _OF_SCAN, lambda given: ImportOptions(**given, named=option_name))
def import_command(
    source: Annotated[Path, file_argument("SRC", "File or folder of another program (docs: import.md).")],
    options: ImportOptions,
    grid: GridChoice,
    output: Annotated[Path | None, file_option("Scan file to write; an existing one is replaced.", "--output", "-o")] = None,
    template: Annotated[bool, option(_TEMPLATE, True, "--template")] = False,
    form: Annotated[FormatName | None, option("Format of SRC.", "recognised", "--format")] = None,  # type: ignore[valid-type]
) -> None:
    if template:
        if output is not None:
            raise InputError("--output", f"{output} with --template, which prints", "one of both", "write > scan.toml")
        say(TEMPLATE)
        return
    if output is None:
        raise InputError("--output", "nothing", "a scan file to write", "say -o scan.h5")
    _refuse_overwriting(source, output)
    check_output(output)
    format_name = form or recognise(source)
    with only_run(output):
        stored = import_scan(source, options, format_name)
        scan = stored.with_grid(grid)
        if stored.reference is not None and scan.reference is None:
            remark(f"{output}: the reference of {source} is on another grid and is left out")
        with finish_despite_interrupt():
            write_scan(output, scan)
    frames, rows, columns = scan.projections.shape
    bad = np.zeros(1, bool) if scan.pixel_mask is None else np.asarray(scan.pixel_mask) != 0
    unusable = [] if bad.ndim < 3 else np.flatnonzero(bad.all((1, 2))).tolist()
    if unusable:
        remark(f"no pixel can be used in {len(unusable)} frames (from 0): {', '.join(map(str, unusable[:10]))}")
    facts = [f"{frames} frames of {rows}×{columns}", *_applied_in_words(scan), "fly-scan" if scan.is_fly else "at rest"]
    facts.append(f"{np.count_nonzero(bad)} pixels masked")
    lines = f"{output}: {format_name}, {', '.join(facts)}", str(scan.provenance[TAKEN]), scan.summary()
    say("\n".join(filter(None, lines)))


import_command.__doc__ = f"Import a scan: {', '.join(dict.fromkeys(whose for _, whose, _ in FORMATS.values()))}."


def _applied_in_words(scan: Scan) -> list[str]:
    """Returns how many flats and darks were applied, as in ["10 flats and 5 darks applied"]; [] if none were."""
    counts = [scan.provenance.get(key, 0) for key in APPLIED]
    if not any(counts):
        return []
    words = [f"{count} {name}{'' if count == 1 else 's'}" for count, name in zip(counts, ("flat", "dark"), strict=True)]
    return [f"{' and '.join(words)} applied"]


def _refuse_overwriting(source: Path, output: Path) -> None:
    """Raises InputError if ``output`` is the input ``source``, or a file in the input's folder that is no scan file."""
    target, origin = output.resolve(), source.resolve()
    folder = origin if origin.is_dir() else origin.parent
    refuse_overwriting("--output", output, source)
    if folder not in target.parents or not target.exists():
        return
    with suppress(InputError):
        if file_kind(output) == "scan":
            return
    raise InputError("--output", f"{output}, which lies with the input and is no scan file", "another file to write")
