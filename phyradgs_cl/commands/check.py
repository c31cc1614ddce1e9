"""check: what is wrong or suspicious in a scan."""

import json
import math
from pathlib import Path
from typing import Annotated

from phyradgs_cl.check import CANNOT_TELL, CheckResult, CountReader, check
from phyradgs_cl.commands.console import AsJson, say
from phyradgs_cl.commands.files import file_option, option
from phyradgs_cl.commands.options import Device, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import check_writable, only_run, read_scan
from phyradgs_cl.io.scan.copy import copy_with_offset
from phyradgs_cl.progress import Ticker
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import device_wish
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.workflow.files import expecting, refuse_foreign_suffix, refuse_overwriting

EXAMPLE = "Example: phyradgs check scan.h5"
SUSPICIOUS_STATUS = 10
_NOT_ASKED = "not asked: which end of the panel is up (row 0; --row-0 of import), as no frame can tell"
_FIX_OFFSET = "Write a copy of the scan (-o) with the centre-of-rotation offset that was found."


def check_command(
    scan: Scan,
    as_json: AsJson = False,
    fix_offset: Annotated[bool, option(_FIX_OFFSET, True, "--fix-offset")] = False,
    output: Annotated[
        Path | None, file_option("The copy to write, with --fix-offset.", "--output", "-o", default=False)
    ] = None,
    device: Device = None,
) -> int:
    """Look for what is wrong or suspicious in a scan: timing, angles, pixels, order of frames,
    signs, gain, centre of rotation.

    Frames that do not fit together are named, and other questions then answered without them, or not at all.
    Ends with status 0 if nothing was found and 10 if something is suspicious.
    """
    wish = device_wish(device)
    target = _checked_output(scan, fix_offset, output)
    counts = CountReader()
    with Ticker("question") as ticker:
        ticker.stage(f"reading {scan.name}")
        with expecting(scan, "scan"):
            loaded = read_scan(scan, counts)
        found = check(loaded, Runtime(wish), counts, lambda done, total, name: ticker.show(done, total, f"  {name}"))
    say(_as_json(found, scan) if as_json else _as_text(found))
    if target is not None:
        _write_copy(scan, target, found, quiet=as_json)
    return SUSPICIOUS_STATUS if found.suspicious else 0


def _checked_output(scan: Path, fix_offset: bool, output: Path | None) -> Path | None:
    if fix_offset != (output is not None):
        found = "--fix-offset without -o" if fix_offset else "-o without --fix-offset"
        raise InputError("check", found, "both or neither", "write for example --fix-offset -o fixed.h5")
    if output is not None:
        refuse_overwriting("-o", output, scan)
        refuse_foreign_suffix(output)
        check_writable(output)
    return output


def _write_copy(scan: Path, target: Path, found: CheckResult, quiet: bool) -> None:
    if not found.is_consistent:
        remedy = "set right what is suspicious, and check again"
        found_instead = "frames that do not fit together as stated"
        raise InputError("--fix-offset", found_instead, "an offset that means something", remedy)
    if not (math.isfinite(found.offset_mm) and math.isfinite(found.offset_spread_mm)):
        expected = "a scan whose frames tell it"
        raise InputError("--fix-offset", "no offset that fits best", expected, "leave it out")
    with only_run(target), finish_despite_interrupt():
        copy_with_offset(scan, target, found.offset_mm)
    if not quiet:
        say(f"{target}: a copy with the panel moved {found.offset_mm:+.4g} mm along u")


def _as_text(found: CheckResult) -> str:
    """A line per question, what to do below it, and the sum."""
    lines: list[str] = []
    for finding in found.findings:
        lines.append(f"{finding.verdict:12s} {finding.question:19s} {finding.text}")
        if finding.advice:
            lines.append(f"{'':33s}-> {finding.advice}")
    count = len(found.suspicious)
    unsure = [finding.question for finding in found.findings if finding.verdict == CANNOT_TELL]
    lines.append(_NOT_ASKED)
    named = f": {', '.join(unsure)}" if unsure else ""
    lines.append(f"{count} of {len(found.findings)} questions suspicious, {len(unsure)} cannot be told{named}")
    return "\n".join(lines)


def _as_json(found: CheckResult, scan: Path) -> str:
    offset = {"offset_mm": found.offset_mm, "offset_spread_mm": found.offset_spread_mm}
    known = {key: value if math.isfinite(value) else None for key, value in offset.items()}
    facts = {"scan": str(scan), "suspicious": len(found.suspicious), **known}
    return json.dumps({**facts, "findings": [finding.facts() for finding in found.findings]})
