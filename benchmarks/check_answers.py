"""Asks `phyradgs check` about a folder of good scans and of scans with planted faults: one line of JSON per scan, resumable.

    python benchmarks/check_answers.py FOLDER RESULTS.jsonl [--only PART,...]

FOLDER is what benchmarks/check_scans/make_scans.py writes: scans, and ``manifest.jsonl`` with one line per scan. A line has
the planted fault, the questions that may rightly be suspicious (``right``), and, where no frame shows the fault, the reason
(``undecidable``)."""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scans import append, lines_of, read_lines

from phyradgs_cl import __version__
from phyradgs_cl.check import CANNOT_TELL, SUSPICIOUS, CountReader, check
from phyradgs_cl.errors import PhyradgsError
from phyradgs_cl.io import read_scan
from phyradgs_cl.runtime import Runtime

FACTS = ("file", "group", "kind", "object", "planted", "right", "undecidable")


def run_all(folder: Path, results: Path, only: list[str], device: str | None) -> None:
    rt = Runtime(device)
    done = {line["file"] for line in read_lines(results)}
    for scan in lines_of(folder / "manifest.jsonl"):
        name = str(scan["file"])
        if name not in done and any(part in name for part in only):
            append(results, {key: scan[key] for key in FACTS} | run_one(rt, folder / name))


def run_one(rt: Runtime, path: Path) -> dict[str, object]:
    started, cpu_started = time.perf_counter(), time.process_time()
    try:
        counts = CountReader()
        found = check(read_scan(path, counts), rt, counts)
    except PhyradgsError as error:
        return {"findings": [], "error": str(error), "version": __version__}
    return {
        "findings": [finding.facts() for finding in found.findings],
        "seconds": round(time.perf_counter() - started, 2),
        "cpu_seconds": round(time.process_time() - cpu_started, 2),
        "device": rt.device.name,
        "version": __version__,
    }


def outcome(line: dict[str, Any]) -> str:
    """Returns the outcome of a line. A good scan has silent or false alarm. Another scan has found, cannot tell, or missed,
    and whether another cause is blamed. ``leaves no trace``: no frame can show the fault, and there was no answer to it."""
    said = {f["question"]: f["verdict"] for f in line["findings"]}
    suspicious = {question for question, verdict in said.items() if verdict == SUSPICIOUS}
    beside = suspicious - set(line["right"])
    if line["group"] == "good":
        return "false alarm" if beside else "silent"
    unsure = any(said.get(question) == CANNOT_TELL for question in line["right"])
    if suspicious & set(line["right"]) or "error" in line:
        answer = "found"
    else:
        answer = "cannot tell" if unsure else "leaves no trace" if line["undecidable"] else "missed"
    return f"{answer}, wrong cause blamed" if beside else answer


def summary(lines: Sequence[dict[str, Any]]) -> str:
    """Returns each outcome with the number of its scans and what was planted in them."""
    planted: dict[tuple[str, str], list[str]] = {}
    for line in lines:
        planted.setdefault((line["group"], outcome(line)), []).append(f"{line['planted']} ({line['object']})")
    return "\n".join(f"{group}, {answer}, {len(of)}: {'; '.join(of)}" for (group, answer), of in sorted(planted.items()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of scans")
    parser.add_argument("results", type=Path, help="JSON lines, appended to")
    parser.add_argument("--only", default="", help="comma-separated parts of file names")
    parser.add_argument("--device", default=None)
    asked = parser.parse_args()
    run_all(asked.folder, asked.results, asked.only.split(","), asked.device)
    print(summary(lines_of(asked.results)))


if __name__ == "__main__":
    main()
