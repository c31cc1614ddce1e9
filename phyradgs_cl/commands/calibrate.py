"""calibrate: a scan's true geometry and timing from its own frames."""

import json
from pathlib import Path
from typing import Annotated

import numpy as np

from phyradgs_cl.acquisition import Scan as Loaded
from phyradgs_cl.calibrate import Calibration, Found, calibrate
from phyradgs_cl.calibrate.parameters import DIRECTION, GROUPS, MOTION, PARAMETERS, WOBBLE
from phyradgs_cl.calibrate.picture import calibration_figure
from phyradgs_cl.commands.console import AsJson, say
from phyradgs_cl.commands.files import file_option, option
from phyradgs_cl.commands.options import Device, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import load_beads
from phyradgs_cl.io import check_writable, only_run, written_beside
from phyradgs_cl.io.scan.copy import copy_with_motion
from phyradgs_cl.progress import Ticker
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import device_wish
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.text import to_digits_of
from phyradgs_cl.workflow.files import load_scan, refuse_foreign_suffix, refuse_overwriting

EXAMPLE = "Example: phyradgs calibrate scan.h5 -o calibrated.h5"
_NAMES = [*GROUPS, *(name for name in PARAMETERS if name not in GROUPS), WOBBLE, MOTION, DIRECTION]
_WHAT = f"What to look for, with commas: {', '.join(_NAMES)}."
_USUAL = "offset,roll,tilt; of a fly-scan also readout,exposure; with --phantom also distance"
_OUTPUT = "The scan to write, with what was corrected; all else stays as it is. An existing file is replaced whole."
_PHANTOM = "What was scanned: a TOML file of beads and wires (docs/formats.md), wherever they lie."
_SPLINES = "A wobble that changes slowly: views go by N cubic splines of time, at least 4."
_WITH = "Another scan of the same object, which lies as it did: turned the other way, it tells readout and exposure."


def calibrate_command(
    scan: Scan,
    output: Annotated[Path | None, file_option(_OUTPUT, "--output", "-o", default="none is written")] = None,
    what: Annotated[str | None, option(_WHAT, _USUAL)] = None,
    other: Annotated[Path | None, file_option(_WITH, "--with", default=False)] = None,
    phantom: Annotated[Path | None, file_option(_PHANTOM, "--phantom", default=False)] = None,
    splines: Annotated[int, option(_SPLINES, "0: every view by itself", metavar="N")] = 0,
    picture: Annotated[
        Path | None, file_option("PNG of residuals before and after, and of views.", "--picture", default="OUTPUT with .png")
    ] = None,
    as_json: AsJson = False,
    device: Device = None,
) -> None:
    """Find a scan's true geometry and timing from its own frames, say how sure that is, and leave as stated what they
    cannot tell."""
    wish = device_wish(device)
    picture = picture or (output and output.with_suffix(".png"))
    if output is not None:
        refuse_foreign_suffix(output)
    if picture is not None and picture.suffix.lower() != ".png":
        raise InputError("--picture", str(picture), "a file name that ends in .png")
    for flag, target in (("-o", output), ("--picture", picture)):
        if target is not None:
            refuse_overwriting(flag, target, scan, *(path for path in (other, phantom) if path is not None))
            check_writable(target)
    with Ticker("pass") as ticker:
        ticker.stage(f"reading {scan}")
        shape = None if phantom is None else load_beads(phantom)
        loaded, others = load_scan(scan), [] if other is None else [load_scan(other)]
        if output is not None:
            _check_storable(loaded, [word.strip() for word in (what or "").split(",")])
        report = lambda done, total, at, share: ticker.show(done, total, f"  {at}", share)  # noqa: E731
        found = calibrate(loaded, Runtime(wish), what, others, report, shape, splines)
    if output is not None:
        with only_run(output), finish_despite_interrupt():
            copy_with_motion(scan, output, found.scan)
    if picture is not None:
        with finish_despite_interrupt(), written_beside(picture) as temporary:
            calibration_figure(found).savefig(temporary, format="png", dpi=110)
    written = {name: str(path) for name, path in (("output", output), ("picture", picture)) if path is not None}
    say(json.dumps({"scan": str(scan), **found.facts(), **written}) if as_json else _as_text(found))
    if output is not None and not as_json:
        said = ", ".join(one.name for one in found.corrected) or "nothing"
        say(f"{output}: {said} corrected")
    if picture is not None and not as_json:
        say(f"{picture}: residuals before and after")


def _check_storable(scan: Loaded, asked: list[str]) -> None:
    """InputError where a file has no place: for another light of its frames, or in a table of poses over time for views of
    their own."""
    if "drift" in asked:
        remedy = "leave -o out, and normalise frames by 'phyradgs prepare --steps air'"
        raise InputError("--what drift", "with -o", "a copy whose frames stay as they are", remedy)
    if WOBBLE not in asked:
        return
    closest_s = float(np.diff(np.sort(scan.frame_start_s)).min(initial=np.inf))
    if scan.is_fly and closest_s <= scan.shutter.span_s:
        found = f"frames of {scan.shutter.span_s:.4g} s that begin every {closest_s:.4g} s"
        remedy = "use api.calibrate, whose scan need not be a file, or leave -o out"
        raise InputError("--what wobble", found, "frames that do not overlap in time: a file has one pose at a time", remedy)


def _as_text(found: Calibration) -> str:
    """A line per parameter, the combinations that leave no trace, and what is left of the frames."""
    lines = [f"{'parameter':18s} {'stated':>12s} {'found':>25s}      verdict"]
    for one in found.parameters:
        lines.append(f"{one.name:18s} {one.stated:12.6g} {_value(one):>25s} {one.unit:4s} {one.verdict}")
    lines += [f"cannot be told apart: {words}" for words in found.alike]
    before, after = found.residual_rms
    lines.append(f"residual of the frames: {before:.4g} before, {after:.4g} after (RMS of line integrals)")
    return "\n".join(lines)


def _value(one: Found) -> str:
    """The estimate to two digits of its deviation; a dash where there is none."""
    if one.found is None or one.deviation is None:
        return "-"
    return f"{to_digits_of(one.found, one.deviation)} ± {to_digits_of(one.deviation, one.deviation)}"
