"""One run of a sweep, wherever it is made: in a worker or in this process."""

import json
import logging
import math
import platform
import time
from datetime import datetime, timezone
from typing import Any

from phyradgs_cl import __version__
from phyradgs_cl.cluster import forget_runtimes, runtime_of_process
from phyradgs_cl.errors import DeviceError, OutputError, PhyradgsError
from phyradgs_cl.io import written_beside
from phyradgs_cl.io.json_lines import Line, json_text
from phyradgs_cl.io.lock import BusyError
from phyradgs_cl.reconstructors import ProgressReport, ignore_progress
from phyradgs_cl.runtime.environment import environment
from phyradgs_cl.workflow.reconstruct import go_on, is_whole
from phyradgs_cl.workflow.sweep.plan import SweepRun, is_sound, same_run

_BUSY_S, _BUSY_EVERY_S = 600.0, 1.0
_LONGEST_ERROR = 2000
log = logging.getLogger(__name__)


def make_run(run: SweepRun, report: ProgressReport = ignore_progress, device: str | None = None) -> Line:
    """The line of a run, with its error where it fails: made now, or kept beside its volume by a worker whose answer
    was lost. Raises KeyboardInterrupt for a run that was stopped, OutputError where nothing can be written."""
    if (kept := _kept(run)) is not None:
        return kept
    try:
        return _made(run, report, device)
    except (PhyradgsError, MemoryError) as error:
        if isinstance(error, OutputError) and not isinstance(error, BusyError):
            raise
        if isinstance(error, DeviceError):
            forget_runtimes()
        return failed_line(run, str(error) or type(error).__name__)
    except Exception as error:  # a defect that one run meets must not cost a night's other runs
        log.exception("%s", run.name)
        forget_runtimes()
        return failed_line(run, f"{type(error).__name__}: {error}")


def _made(run: SweepRun, report: ProgressReport, device: str | None) -> Line:
    """Waits while another worker, that its scheduler has lost sight of, is still at the same run."""
    deadline = time.monotonic() + _BUSY_S
    while True:
        try:
            return _reconstructed(run, report, device)
        except BusyError:
            if time.monotonic() > deadline:
                raise
            time.sleep(_BUSY_EVERY_S)
        if (kept := _kept(run)) is not None:
            return kept


def _reconstructed(run: SweepRun, report: ProgressReport, device: str | None) -> Line:
    started = time.perf_counter()
    with runtime_of_process(device) as rt:
        result, metrics = go_on(run.job, lambda: rt, report)
        if not is_whole(result):
            raise KeyboardInterrupt
        line = {
            **run.facts,
            "metrics": {name: _number(value) for name, value in metrics.items()},
            "seconds": round(float(result.facts["seconds"]), 3),
            "total_s": round(time.perf_counter() - started, 3),
            "gaussians": result.facts.get("gaussians"),
            **environment(rt),
            "host": platform.node(),
        }
    with written_beside(run.record) as temporary:
        temporary.write_text(json_text(line), encoding="utf-8")
    return line


def _kept(run: SweepRun) -> Line | None:
    """The result beside the volume, where it is of this run and the volume is there."""
    if not run.job.output.is_file():
        return None
    try:
        line = json.loads(run.record.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):  # not there, not JSON, or JSON too deep
        return None
    return line if isinstance(line, dict) and is_sound(line) and same_run(line, run.facts) else None


def failed_line(run: SweepRun, error: str) -> Line:
    """The line of a run that failed, or whose workers died."""
    finished = datetime.now(timezone.utc).isoformat(timespec="seconds")
    told = error[:_LONGEST_ERROR]  # a compiler's may have many pages
    here = {"version": __version__, "host": platform.node(), "finished": finished}
    return {**run.facts, "error": told, **here}


def _number(value: Any) -> float | None:
    """JSON has neither NaN nor infinity."""
    return float(value) if math.isfinite(value) else None
