"""The command calibrate: estimates a scan's true geometry and timing from its own frames."""

from pathlib import Path
from typing import Annotated

import numpy as np

from phyradgs_cl.acquisition import Scan as Loaded
from phyradgs_cl.calibrate import Calibration, calibrate
from phyradgs_cl.calibrate.parameters import NAMES, WOBBLE
from phyradgs_cl.commands.console import AsJson, file_option, option, say, say_json
from phyradgs_cl.commands.options import Device, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import load_beads
from phyradgs_cl.io import only_run, written_beside
from phyradgs_cl.io.scan.motion import overlaps
from phyradgs_cl.io.scan.writer import copy_with_motion
from phyradgs_cl.progress import Ticker
from phyradgs_cl.settings import runtime_for
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.workflow.files import check_output, check_picture, load_scan

EXAMPLES = {"calibrate": "Example: phyradgs calibrate scan.h5 -o calibrated.h5"}
GROUPS = {"calibrate": {
    "Basics": ("output", "what", "other", "phantom", "picture"), "Run": ("splines", "as_json", "device"),
}}
_WHAT = f"Parameters to estimate, with commas: {', '.join(NAMES)}."
_USUAL = "offset,roll,tilt; of a fly-scan also readout,exposure; with --phantom also distance"
_OUTPUT = "The scan to write, with the corrections. An existing file is replaced."
_PHANTOM = "The object, if its shape is known: a TOML file of beads and wires (docs/formats.md), in any place."
_SPLINES = "Let a wobble follow N cubic splines of time, at least 4."
_WITH = "Another scan of the same object in the same place. Turned the other way, it determines readout and exposure."
_UNDETERMINED = "parameters that are not determined stay as stated; docs/calibrate.md lists the scan that each needs"
_PICTURE = "PNG of residuals before and after, and of corrections per view."


def calibrate_command(
    scan: Scan,
    output: Annotated[Path | None, file_option(_OUTPUT, "--output", "-o", default="none is written")] = None,
    what: Annotated[str | None, option(_WHAT, _USUAL)] = None,
    other: Annotated[Path | None, file_option(_WITH, "--with", default=False)] = None,
    phantom: Annotated[Path | None, file_option(_PHANTOM, "--phantom", default=False)] = None,
    splines: Annotated[int, option(_SPLINES, "0: every view by itself", metavar="N")] = 0,
    picture: Annotated[Path | None, file_option(_PICTURE, "--picture", default="OUTPUT with .png")] = None,
    as_json: AsJson = False, device: Device = None,
) -> None:
    """Estimate a scan's true geometry and timing from its own frames, with standard deviations.

    Corrects the parameters that differ from the stated ones by three deviations. Parameters that the frames do not
    determine stay as stated."""
    if output is not None:
        check_output(output, scan, other, phantom)
        picture = picture or output.with_suffix(".png")
    if picture is not None:
        check_picture("--picture", picture, scan, other, phantom)
    with Ticker("pass") as ticker:
        ticker.stage(f"reading {scan}")
        shape = None if phantom is None else load_beads(phantom)
        loaded, others = load_scan(scan), [] if other is None else [load_scan(other)]
        if output is not None:
            _check_storable(loaded, [word.strip() for word in (what or "").split(",")])
        report = lambda done, total, phase, share: ticker.show(done, total, f"  {phase}", share)  # noqa: E731
        result = calibrate(loaded, runtime_for(device), what, others, report, shape, splines, ticker.note)
    written, lines = {}, []
    if output is not None:
        with only_run(output), finish_despite_interrupt():
            copy_with_motion(scan, output, result.scan)
        written["output"] = str(output)
        lines.append(f"{output}: {', '.join(one.name for one in result.corrected) or 'nothing'} corrected")
    if picture is not None:
        with finish_despite_interrupt(), written_beside(picture) as temporary:
            result.plot().savefig(temporary, format="png", dpi=110)
        written["picture"] = str(picture)
        lines.append(f"{picture}: residuals before and after")
    facts = {"scan": str(scan), **result.facts(), **written}
    if as_json:
        say_json(facts)
    else:
        say("\n".join([_as_text(result), *lines]))


def _check_storable(scan: Loaded, names: list[str]) -> None:
    """Raises InputError if ``names`` has the wobble and frames overlap in time: a scan file has only one pose at a time."""
    if WOBBLE not in names:
        return
    if scan.is_fly and overlaps(scan):
        period_s = float(np.diff(np.sort(scan.frame_start_s)).min())
        frames = f"frames of {scan.shutter.span_s:.4g} s that begin every {period_s:.4g} s"
        expected = "frames that do not overlap in time, because a file has one pose at a time"
        remedy = "leave -o out, or use api.calibrate, whose result need not be a file"
        raise InputError("--what wobble", frames, expected, remedy)


def _as_text(result: Calibration) -> str:
    lines = [f"{'parameter':18s} {'stated':>12s} {'found':>25s}      verdict"]
    for one in result.parameters:
        lines.append(f"{one.name:18s} {one.stated:12.6g} {one.words:>25s} {one.unit:4s} {one.verdict}")
    lines += [f"not determined: {words}" for words in result.alike]
    if result.alike:
        lines.append(_UNDETERMINED)
    before, after = result.residual_rms
    lines.append(f"residual of the frames: {before:.4g} before, {after:.4g} after (RMS of line integrals)")
    return "\n".join(lines)
