"""The runs of a sweep, each with a name that follows from what it is."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from phyradgs_cl.io.hdf5.facts import FINITE, SECONDS, TABLE, TEXT, WHOLE, Schema, damage
from phyradgs_cl.io.json_lines import Line
from phyradgs_cl.io.output import shortened
from phyradgs_cl.reconstructors import input_options
from phyradgs_cl.text import plain_text
from phyradgs_cl.workflow.reconstruct import ReconstructionJob
from phyradgs_cl.workflow.sweep.grid import Setting, SweepGrid

VOLUMES = "volumes"
# What makes a line of the results file that of a run: its name, and the scan file as it is now.
KEY = ("run", "scan", "scan_bytes", "scan_mtime_ns")
_STEM_BYTES = 80
# What tables read of a line, and more of one that is no error.
_KINDS: Schema = {
    **dict.fromkeys(("run", "scan", "method", "preset", "label", "error"), TEXT),
    **dict.fromkeys(("scan_bytes", "scan_mtime_ns", "seed", "gaussians"), WHOLE),
    **dict.fromkeys(("device", "host", "version", "volume"), TEXT),
    **dict.fromkeys(("changes", "input", "options"), TABLE),
    "metrics": FINITE,
    "seconds": SECONDS,
}
_ALWAYS, _OF_RESULTS = (*KEY, "label", "changes", "input"), ("metrics", "seconds")


def is_sound(line: Line) -> bool:
    """Whether a line of the results file is of a run, and every field of its kind."""
    return not damage(line, _KINDS, (*_ALWAYS, *(("error",) if "error" in line else _OF_RESULTS)))


@dataclass(frozen=True, eq=False)
class SweepRun:
    """One reconstruction, as it is sent to a worker; ``facts`` identify it in the results file."""

    name: str
    job: ReconstructionJob
    facts: Line

    @property
    def record(self) -> Path:
        """Where its result is kept beside its volume, until and after it is in the results file."""
        return self.job.output.with_suffix(".json")


def plan_sweep(grid: SweepGrid, folder: Path, checkpoint_every_s: float = 600.0) -> list[SweepRun]:
    """Every run, a scan after the other; volumes go to ``folder``/volumes."""
    return list(_planned(grid, folder.resolve(), checkpoint_every_s))


def _planned(grid: SweepGrid, folder: Path, every_s: float) -> Iterator[SweepRun]:
    for scan in grid.scans:
        stat = scan.stat()
        for setting in grid.settings:
            options = plain(asdict(setting.options()))
            for seed in grid.seeds:
                name = _name(scan, setting, seed)
                volume, before = folder / VOLUMES / f"{name}.h5", input_options(setting.before)
                what = (setting.method, setting.preset, setting.changes, seed)
                job = ReconstructionJob(scan, volume, *what, before=before, checkpoint_every_s=every_s)
                facts = {
                    "run": name,
                    "scan": plain_text(str(scan)),
                    "scan_bytes": stat.st_size,
                    "scan_mtime_ns": stat.st_mtime_ns,
                    "method": setting.method,
                    "preset": setting.preset,
                    "label": setting.label,
                    "changes": plain(setting.changes),
                    "input": plain(setting.before),
                    "options": options,
                    "seed": seed,
                    "volume": f"{VOLUMES}/{name}.h5",
                }
                yield SweepRun(name, job, facts)


def same_run(line: Line, facts: Line) -> bool:
    """Whether a line is of the run that ``facts`` describe, on the scan file as it is."""
    return all(line.get(name) == facts[name] for name in KEY)


def missing_runs(plan: Sequence[SweepRun], lines: Sequence[Line]) -> list[SweepRun]:
    """The runs without a line that is no error."""
    done = {tuple(line.get(name) for name in KEY) for line in lines if "error" not in line}
    return [run for run in plan if tuple(run.facts[name] for name in KEY) not in done]


def plain(value: Any) -> Any:
    """A value as it comes back from JSON: tuples are lists."""
    return json.loads(json.dumps(value, default=str))


def _name(scan: Path, setting: Setting, seed: int) -> str:
    """Names of scan and method for people, a digest against equal names, the seed."""
    identity = [str(scan), setting.method, setting.preset, plain(setting.changes), plain(setting.before)]
    digest = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:10]
    return f"{shortened(plain_text(scan.stem), _STEM_BYTES)}_{setting.method}_{digest}_s{seed}"
