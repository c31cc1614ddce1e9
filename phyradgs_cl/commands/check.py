"""The command check: finds what is wrong or suspicious in a scan."""

import math
from pathlib import Path
from typing import Annotated

from phyradgs_cl.acquisition.plausible import blur_facts, blur_line
from phyradgs_cl.check import CANNOT_TELL, CENTRE, CheckResult, CountReader, check
from phyradgs_cl.commands.console import AsJson, file_option, option, say, say_json
from phyradgs_cl.commands.options import Device, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import only_run, read_scan
from phyradgs_cl.io.scan.writer import copy_with_offset
from phyradgs_cl.progress import Ticker
from phyradgs_cl.settings import runtime_for
from phyradgs_cl.signals import finish_despite_interrupt
from phyradgs_cl.workflow.files import check_output, expecting

EXAMPLES = {"check": "Example: phyradgs check scan.h5"}
SUSPICIOUS_STATUS = 10  # exit status if something is suspicious
_NOT_ASKED = "not asked: which end of the panel is up (row 0; --row-0 of import), because no frame shows it"
_COPY = "The copy to write, with --fix-offset."
_FIX_OFFSET = "Write a copy of the scan (-o) whose panel is shifted along u to the centre of rotation that was found."


def check_command(
    scan: Scan,
    as_json: AsJson = False,
    fix_offset: Annotated[bool, option(_FIX_OFFSET, True, "--fix-offset")] = False,
    output: Annotated[Path | None, file_option(_COPY, "--output", "-o", default=False)] = None,
    device: Device = None,
) -> int:
    """Look for what is wrong or suspicious in a scan: timing, angles, pixels, coverage, order of frames, geometry, gain.

    Frames that do not fit the others are named, and further questions are answered without them. Exit status: 0 if nothing
    is suspicious, or if --fix-offset has corrected the only suspicious answer; 10 otherwise."""
    if fix_offset != (output is not None):
        combination = "--fix-offset without -o" if fix_offset else "-o without --fix-offset"
        raise InputError("check", combination, "both or neither", "write for example --fix-offset -o fixed.h5")
    if output is not None:
        check_output(output, scan)
    counts = CountReader()
    with Ticker("question") as ticker:
        ticker.stage(f"reading {scan.name}")
        with expecting(scan, "scan"):
            loaded = read_scan(scan, counts)
        result = check(loaded, runtime_for(device), counts, lambda done, total, name: ticker.show(done, total, f"  {name}"))
    if as_json:
        say_json(_facts(result, scan, blur_facts(loaded)))
    else:
        say(_as_text(result, blur_line(loaded)))
    suspicious = {finding.question for finding in result.suspicious}
    if output is not None:
        _write_copy(scan, output, result, quiet=as_json)
        suspicious.discard(CENTRE)
    return SUSPICIOUS_STATUS if suspicious else 0


def _write_copy(scan: Path, target: Path, result: CheckResult, quiet: bool) -> None:
    if not result.is_consistent:
        expected, remedy = "frames that fit together", "correct what is suspicious above, and check again"
        raise InputError("--fix-offset", "frames that do not fit together as stated", expected, remedy)
    if not (math.isfinite(result.offset_mm) and math.isfinite(result.offset_spread_mm)):
        expected = "a scan whose frames determine the offset"
        raise InputError("--fix-offset", "no offset that fits best", expected, "leave --fix-offset out")
    with only_run(target), finish_despite_interrupt():
        copy_with_offset(scan, target, result.offset_mm)
    if not quiet:
        say(f"{target}: a copy with the panel moved {result.offset_mm:+.4g} mm along u")


def _as_text(result: CheckResult, blur: str) -> str:
    lines: list[str] = []
    for finding in result.findings:
        lines.append(f"{finding.verdict:12s} {finding.question:19s} {finding.text}")
        lines += [f"{'':33s}-> {finding.advice}"] if finding.advice else []
    open_questions = [finding.question for finding in result.findings if finding.verdict == CANNOT_TELL]
    names = f": {', '.join(open_questions)}" if open_questions else ""
    suspicious = f"{len(result.suspicious)} of {len(result.findings)} questions suspicious"
    lines += [blur] if blur else []
    return "\n".join([*lines, _NOT_ASKED, f"{suspicious}, {len(open_questions)} cannot be told{names}"])


def _facts(result: CheckResult, scan: Path, blur: dict[str, float]) -> dict[str, object]:
    facts = {"scan": str(scan), "suspicious": len(result.suspicious), "offset_mm": result.offset_mm}
    facts |= {"offset_spread_mm": result.offset_spread_mm, **blur}
    return {**facts, "findings": [finding.facts() for finding in result.findings]}
