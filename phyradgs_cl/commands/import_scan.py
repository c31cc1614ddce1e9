"""import: a scan of another program to a scan file."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.scan import APPLIED
from phyradgs_cl.commands.console import file_argument, file_option, option, remark, say
from phyradgs_cl.commands.options import (
    DETECTOR_OFFSET,
    Axis,
    DetectorModel,
    First,
    RoiMm,
    Size,
    VoxelMm,
    lengths,
    pitches,
)
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import GridChoice
from phyradgs_cl.importers import FORMATS, ImportOptions, import_scan, recognise
from phyradgs_cl.importers.formats.tiff_template import template_of
from phyradgs_cl.importers.options import FIELDS, WORDS, option_name
from phyradgs_cl.io import file_kind, only_run, write_scan
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.workflow.files import check_output

EXAMPLES = {
    "import": (
        "Example: phyradgs import chest_50.pickle -o scan.h5\n\n"
        "Example: phyradgs import scan.xml -o scan.h5 --fps 15 --exposure-s 0.06 --readout-ms 62 --first top\n\n"
        "Example: phyradgs import tiffs --template > tiffs/scan.toml"
    )
}

FormatName = Literal[tuple(FORMATS)]  # type: ignore[valid-type]
AngleAt = Literal[WORDS["angle_at"]]  # type: ignore[name-defined, valid-type]
Part = Literal[WORDS["part"]]  # type: ignore[name-defined, valid-type]
Quantity = Literal[WORDS["quantity"]]  # type: ignore[name-defined, valid-type]
Rotates = Literal[WORDS["rotates"]]  # type: ignore[name-defined, valid-type]
Row0 = Literal[WORDS["row_0"]]  # type: ignore[name-defined, valid-type]
Column0 = Literal[WORDS["column_0"]]  # type: ignore[name-defined, valid-type]

_TEMPLATE = "Print a TOML to fill in for a folder of TIFFs, and write nothing."
_DIRECTION = "1 reads row 0 (lowest) or column 0 (left) first, -1 last."
_MODEL = "An exposure averages line integrals (log) or intensity."
_FILE, _FORMAT = "the file's", "the format's"
GROUPS = {
    "import": {
        "Basics": (
            *("output", "template", "form", "source_to_axis_mm", "source_to_detector_mm", "pixel_size_mm"),
            *("fps", "exposure_s", "readout_ms", "first"),
        ),
        "Geometry": ("detector_offset_mm", "unit_mm", "rotates"),
        "Timing": ("frame_time_s", "readout_s", "angle_at", "readout_axis", "readout_direction", "detector_model"),
        "Pixels": ("quantity", "flat_value", "row_0", "column_0", "part", "first_view"),
        "Volume": ("size", "voxel_mm", "roi_mm"),
    }
}


def import_command(
    context: typer.Context,
    source: Annotated[Path, file_argument("SRC", "File or folder of another program (docs: import.md).")],
    output: Annotated[Path | None, file_option("Scan file to write; an existing one is replaced.", "--output", "-o")] = None,
    template: Annotated[bool, option(_TEMPLATE, True, "--template")] = False,
    form: Annotated[FormatName | None, option("Format of SRC.", "recognised", "--format")] = None,  # type: ignore[valid-type]
    exposure_s: Annotated[float | None, option("Exposure of a line, s.", _FILE)] = None,
    readout_ms: Annotated[float | None, option("From the first line's opening to the last line's, ms.", _FILE)] = None,
    readout_s: Annotated[float | None, option("--readout-ms in s.", _FILE)] = None,
    fps: Annotated[float | None, option("Frames per second of a gantry that never stops.", f"{_FILE}, else at rest")] = None,
    frame_time_s: Annotated[float | None, option("From frame to frame, s: in place of --fps.", f"{_FILE}")] = None,
    angle_at: Annotated[AngleAt | None, option("A frame's angle: at its first line's start or middle.", "start")] = None,
    first: Annotated[First | None, option("Line that is read first, seen from the source.", _FORMAT)] = None,
    readout_axis: Annotated[Axis | None, option("Lines of the readout: rows or columns.", _FORMAT, "--readout")] = None,
    readout_direction: Annotated[int | None, option(_DIRECTION, _FORMAT)] = None,
    source_to_axis_mm: Annotated[float | None, option("Source to rotation axis, mm.", _FILE)] = None,
    source_to_detector_mm: Annotated[float | None, option("Source to detector, mm.", _FILE)] = None,
    pixel_size_mm: Annotated[Any, pitches("--pixel-size-mm", "Pixel's side, or height and width, mm.", _FILE)] = None,
    detector_offset_mm: Annotated[Any, lengths("--detector-offset", DETECTOR_OFFSET, _FILE)] = None,
    unit_mm: Annotated[float, option("Length of a scene unit in mm (r2, phyradgs).")] = 1.0,
    rotates: Annotated[Rotates | None, option("The part that the stored angles turn.", _FORMAT)] = None,
    row_0: Annotated[Row0 | None, option("Place of the first stored row.", _FORMAT, "--row-0")] = None,
    column_0: Annotated[Column0 | None, option("Place of the first stored column.", "left", "--column-0")] = None,
    quantity: Annotated[Quantity | None, option("Quantity in the pixels.", _FILE)] = None,
    flat_value: Annotated[float | None, option("Counts without an object, in place of flat frames.", _FILE)] = None,
    detector_model: Annotated[DetectorModel | None, option(_MODEL, "log")] = None,
    part: Annotated[Part, option("Projections of a benchmark folder (r2, phyradgs, naf).")] = "train",
    first_view: Annotated[int | None, option("First view of this scan in a JSON of several (phyradgs-real).", "all")] = None,
    size: Size = None,
    voxel_mm: VoxelMm = None,
    roi_mm: RoiMm = None,
) -> None:
    """Import a scan of another program: R2-Gaussian, PhyRadGS, NAF, RTK, Data Exchange, NXtomo, TIFF."""
    given = {name: value for name, value in context.params.items() if name in FIELDS}
    if template:
        say(template_of(source))
        return
    if output is None:
        raise InputError("--output", "nothing", "a scan file to write", "say -o scan.h5")
    options = ImportOptions(**given, named=option_name)
    grid = GridChoice(size, voxel_mm, roi_mm)
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
    masked = int(np.count_nonzero(bad))
    unusable = [] if bad.ndim < 3 else np.flatnonzero(bad.all((1, 2))).tolist()
    if unusable:
        remark(f"no pixel can be used in {len(unusable)} frames (from 0): {', '.join(map(str, unusable[:10]))}")
    facts = [f"{frames} frames of {rows}×{columns}", *_applied_in_words(scan), "fly-scan" if scan.is_fly else "at rest"]
    say(f"{output}: {format_name}, {', '.join(facts)}, {masked} pixels masked\n{scan.summary()}")


def _applied_in_words(scan: Scan) -> list[str]:
    """Returns the numbers of flats and darks that were applied, as ["10 flats and 5 darks applied"]; [] without any."""
    counts = [scan.provenance.get(key, 0) for key in APPLIED]
    if not any(counts):
        return []
    words = [f"{count} {name}{'' if count == 1 else 's'}" for count, name in zip(counts, ("flat", "dark"), strict=True)]
    return [f"{' and '.join(words)} applied"]


def _refuse_overwriting(source: Path, output: Path) -> None:
    """Raises InputError for an output that may belong to the input: an existing file in its folder that is no scan file."""
    target, origin = output.resolve(), source.resolve()
    folder = origin if origin.is_dir() else origin.parent
    if target == origin:
        raise InputError("--output", f"the input {source} itself", "another file to write")
    if folder not in target.parents or not target.exists():
        return
    with suppress(InputError):
        if file_kind(output) == "scan":
            return
    found = f"{output}, which lies with the input and is no scan file"
    raise InputError("--output", found, "another file to write")
