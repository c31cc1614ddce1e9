"""Runs commands in one process, one after the other, and says what each cost: python worker.py, cases as JSON lines.

Each line in is a list of arguments; each line out is {status, error, seconds, megabytes}. Standard error is caught at its
descriptor, so that libraries' own complaints count too. Seconds are the process's own, whatever else the machine does.
"""

from __future__ import annotations

import json
import logging
import os
import resource
import sys
import tempfile
import time
import traceback
from pathlib import Path

from phyradgs_cl.__main__ import load_cli


def reset_peak() -> None:
    """Linux counts the peak of resident memory from now on."""
    Path("/proc/self/clear_refs").write_text("5")


def peak_megabytes() -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def cpu_s() -> float:
    """Of this process. The one that tries HDF5 files has a limit of its own, and lives on from file to file."""
    use = resource.getrusage(resource.RUSAGE_SELF)
    return use.ru_utime + use.ru_stime


def main() -> None:
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    run = load_cli().run
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    for line in sys.stdin:
        with tempfile.TemporaryFile() as caught:
            sys.stderr.flush()
            os.dup2(caught.fileno(), 2)
            reset_peak()
            before_s, before_wall_s = cpu_s(), time.monotonic()
            try:
                status = run(json.loads(line))
            except BaseException:  # a defect: its traceback is the answer
                status = 1
                traceback.print_exc()
            logging.shutdown()
            sys.stderr.flush()
            caught.seek(0)
            answer = {
                "status": status,
                "error": caught.read().decode(errors="replace"),
                "seconds": min(cpu_s() - before_s, time.monotonic() - before_wall_s),
                "megabytes": peak_megabytes(),
            }
            answers.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
