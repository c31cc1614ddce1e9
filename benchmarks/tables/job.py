"""The task of a benchmark, and the runs that follow from it, checked before any work."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from phyradgs_cl import checks
from phyradgs_cl.acquisition import PROTOCOLS
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.neural import INSTALL
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from tables.case import FLY, STILL
from tables.identity import content_hash
from tables.results import Line
from tables.rows import Row, candidate_rows, choose_rows, rows_of
from tables.sizes import BenchSize, bench_size
from tables.volumes import find_volumes

SYNTHETIC, PHANTOM = "synthetic", "phantom"
BUILT_IN = ("foot", "jaw")
SPHERES = "spheres"
_DEFAULT_SIZES = {"table1": "S", "table2": "S", "phantom": "M"}
_FLY_PROTOCOLS = tuple(name for name, protocol in PROTOCOLS.items() if protocol.is_fly)


@dataclass(frozen=True)
class BenchJob:
    """Which table, of which volumes, at which size.

    - kind: table1, table2 or phantom.
    - output: folder of the results file and tables. It is made where it is missing.
    - volumes: folder of HDF5 volumes, not for phantom. None takes the built-in phantoms foot and jaw.
    - size: XS, S, M, L, XL or a size of one's own; by default the kind's.
    - names: volumes by name. protocols: rapid (25 views), standard (50). rows: labels of rows. Defaults: all volumes and
      rows, both protocols for table1, rapid for the others.
    - seeds: of noise, jitter, cloud and frame order. iterations: those of the splatting methods, in place of the size's.
    - axis: what is read out at one time, rows or columns."""

    kind: str
    output: Path
    volumes: Path | None = None
    size: str | BenchSize | None = None
    names: Sequence[str] | None = None
    protocols: Sequence[str] | None = None
    rows: Sequence[str] | None = None
    seeds: Sequence[int] = (0,)
    iterations: int | None = None
    axis: str = "rows"

    def __post_init__(self) -> None:
        choose_rows(self.kind, self.rows)
        for name in self.chosen_protocols:
            checks.one_of("--protocols", name, _FLY_PROTOCOLS)
        for seed in self.seeds:
            checks.within("--seeds", seed, 0, 2**63)
        if not self.seeds:
            raise InputError("--seeds", "nothing", "at least one whole number")
        checks.one_of("--readout", self.axis, AXES)
        if self.kind == "phantom" and (self.volumes is not None or self.names):
            raise InputError(
                "--volumes and --names", "given for phantom", "none: it has one object of its own"
            )

    @property
    def bench_size(self) -> BenchSize:
        """Returns the size with the job's own number of iterations."""
        wish = _DEFAULT_SIZES[self.kind] if self.size is None else self.size
        size = bench_size(wish) if isinstance(wish, str) else wish
        return size if self.iterations is None else replace(size, iterations=self.iterations)

    @property
    def chosen_rows(self) -> tuple[Row, ...]:
        return choose_rows(self.kind, self.rows)

    @property
    def chosen_protocols(self) -> tuple[str, ...]:
        return tuple(self.protocols or (("rapid", "standard") if self.kind == "table1" else ("rapid",)))

    @property
    def stem(self) -> str:
        """Returns the beginning of the names of tables: one for each set of results."""
        size = self.bench_size
        own = self.iterations in (None, replace(self, iterations=None).bench_size.iterations)
        parts = self.kind, size.name, "" if own else f"i{size.iterations}", "" if self.axis == "rows" else self.axis
        return "_".join(part for part in parts if part)

    def with_all(self, lines: Sequence[Line]) -> "BenchJob":
        """Returns the job whose table has everything of its kind and size that the lines hold, whatever is to be run now.

        Rows of the kind are always there; others are there if they have results or are asked for."""
        runs = {line.get("run") for line in lines if line.get("acquisition") == FLY}
        always = {row.run for row in (*rows_of(self.kind), *self.chosen_rows)}
        labels = {row.label for row in (*rows_of(self.kind), *self.chosen_rows)}
        more = [r for r in candidate_rows(self.kind) if r.run in runs and r.run not in always]
        rows = [*labels, *(row.label for row in more)]
        return replace(self, rows=rows, names=None, protocols=_FLY_PROTOCOLS)

    @property
    def study(self) -> str:
        """Returns the study: volumes with TIGRE's noise, or the sphere phantom with raw counts."""
        return PHANTOM if self.kind == "phantom" else SYNTHETIC

    def paper_column(self, protocol: str) -> str:
        """Returns the column of the paper's tables for a protocol of this study."""
        return PHANTOM if self.study == PHANTOM else protocol

    @property
    def gaussians(self) -> int:
        """Returns the first cloud's number of Gaussians in every splatting row: the default for the grid."""
        return SplatOptions().gaussians_for(Grid.cube(self.bench_size.voxels, 2.0))

    def sources(self) -> dict[str, Path | None]:
        """Returns volume names with their files; None for a phantom of this package."""
        if self.kind == "phantom":
            return {SPHERES: None}
        if self.volumes is not None:
            return dict(find_volumes(self.volumes, self.names, self.bench_size.voxels))
        for name in self.names or ():
            checks.one_of("--names (without --volumes)", name, BUILT_IN)
        return dict.fromkeys(self.names or BUILT_IN)


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """One reconstruction: its case, its row, and the facts that identify it in the results file."""

    volume: str
    source: Path | None
    protocol: str
    seed: int
    acquisition: str
    row: Row
    options: Any
    facts: Line

    @property
    def case(self) -> tuple[str, str, int]:
        """Returns the key of the case. Runs with the same case share their scans."""
        return self.volume, self.protocol, self.seed

    @property
    def title(self) -> str:
        return f"{self.volume}, {self.protocol}, seed {self.seed}: {self.row.label} ({self.acquisition})"


def plan_runs(job: BenchJob) -> list[PlannedRun]:
    """Returns every run of a job, one case after the other. Rows share their stop-and-shoot runs.

    Raises InputError for rows, volumes or options that do not exist, and where no row can be run."""
    shared = _with_options(job)
    if not shared:
        voxels = job.bench_size.voxels
        asked = ", ".join(f"{row.label} ({row.lacks(voxels)})" for row in job.chosen_rows)
        others = "; ".join(row.label for row in candidate_rows(job.kind) if not row.lacks(voxels))
        raise InputError("--rows", asked, f"one of {others}", INSTALL)
    plan = []
    sources = job.sources()
    hashes = {volume: content_hash(source) for volume, source in sources.items()}
    for seed in dict.fromkeys(job.seeds):
        for volume, source in sources.items():
            for protocol in dict.fromkeys(job.chosen_protocols):
                for acquisition, row, options in shared:
                    facts = _facts(job, volume, source, protocol, seed, acquisition, row, options)
                    facts["source_hash"] = hashes[volume]
                    plan.append(PlannedRun(volume, source, protocol, seed, acquisition, row, options, facts))
    return plan


def _with_options(job: BenchJob) -> list[tuple[str, Row, Any]]:
    """Returns (acquisition, row, options) of every case. Options are checked here, before any work."""
    rows = [row for row in job.chosen_rows if not row.lacks(job.bench_size.voxels)]
    wanted = [(FLY, row) for row in rows] + [(STILL, row.static()) for row in rows]
    unique = {(acquisition, row.run): row for acquisition, row in reversed(wanted)}
    size = job.bench_size
    return [
        (acquisition, row, row.options(job.gaussians, size.iterations))
        for (acquisition, _), row in reversed(unique.items())
    ]


def _facts(
    job: BenchJob, volume: str, source: Path | None, protocol: str, seed: int, acquisition: str, row: Row, options: Any
) -> Line:
    size = job.bench_size
    return {
        "study": job.study,
        "volume": volume,
        "source": source.name if source is not None else "built-in",
        "run": row.run,
        "label": row.label,
        "acquisition": acquisition,
        "method": row.method,
        "size": size.name,
        "voxels": size.voxels,
        "pixels": size.pixels,
        "protocol": protocol,
        "views": PROTOCOLS[protocol].views,
        "axis": job.axis,
        "seed": seed,
        "iterations": size.iterations if row.is_splatting else None,
        "options": plain(asdict(options)),
    }


def plain(value: Any) -> Any:
    """Returns a value as JSON gives it back: tuples become lists."""
    return json.loads(json.dumps(value, default=str))


Report = Callable[["BenchProgress"], None]


@dataclass(frozen=True)
class BenchProgress:
    """Progress of a benchmark: run ``number`` of ``runs``, and the progress of that run. ``line``: its result once done."""

    number: int
    runs: int
    title: str
    iteration: int = 0
    iterations: int = 0
    line: Line | None = None
