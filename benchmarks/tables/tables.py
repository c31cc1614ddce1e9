"""Tables of a benchmark in Markdown and CSV, from the lines of its results file."""

import csv
import io
import logging
from collections.abc import Sequence
from pathlib import Path

from phyradgs_cl.errors import InputError
from phyradgs_cl.io import written_beside
from tables.case import FLY, STILL
from tables.job import BenchJob
from tables.markdown import markdown
from tables.published import published
from tables.results import Line
from tables.rows import Row
from tables.summary import Summary, lines_of, lines_of_run, summarise

log = logging.getLogger(__name__)
METRICS = (
    "psnr_db", "ssim", "psnr_2d_db", "ssim_2d", "psnr_db_pseudo", "ssim_pseudo", "roundness", "roundness_rms",
    "centre_shift_mm", "edge_rise_mm", "bias_balls", "bias_holder", "seconds", "processor_s",
)  # fmt: skip
_FACTS = ("study", "size", "voxels", "pixels", "iterations", "axis", "protocol", "row", "acquisition")


def write_tables(job: BenchJob, lines: Sequence[Line]) -> list[Path]:
    """Writes KIND_SIZE.md and KIND_SIZE.csv into the job's folder. Returns both paths.

    They have all that the lines hold for the kind and size: a run of some rows, volumes or protocols adds to a table. Raises
    InputError where no line of the results file belongs to the table."""
    job = job.with_all(lines)
    chosen = lines_of(job, lines)
    size = job.bench_size
    if not chosen:
        held = sorted({f"{line.get('study')} {line.get('size')}, {line.get('iterations')} iterations" for line in lines})
        wanted = f"runs for {job.kind} at {size.voxels}³, of splats with {size.iterations} iterations"
        raise InputError(str(job.output), "; ".join(held), wanted, "choose --size and --iterations as in the runs")
    written = {
        job.output / f"{job.stem}.md": markdown(job, chosen),
        job.output / f"{job.stem}.csv": comma_separated(job, chosen),
    }
    for path, text in written.items():
        with written_beside(path) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="")
    return list(written)


def comma_separated(job: BenchJob, lines: Sequence[Line]) -> str:
    """Returns a record for each protocol, row and acquisition, with means, spreads over seeds and the paper's numbers."""
    out = io.StringIO()
    columns = [f"{name}{end}" for name in METRICS for end in ("", "_spread")]
    counts = ("volumes", "seeds")
    writer = csv.DictWriter(
        out, [*_FACTS, *counts, *columns, "paper_psnr_db", "paper_ssim"], lineterminator="\n"
    )
    writer.writeheader()
    for protocol in job.chosen_protocols:
        for row in _all_rows(job):
            for acquisition in (FLY, STILL):
                summary = summarise(lines_of_run(lines, protocol, row.run, acquisition))
                if summary is not None:
                    writer.writerow(_record(job, protocol, row, acquisition, summary))
    return out.getvalue()


def _record(job: BenchJob, protocol: str, row: Row, acquisition: str, summary: Summary) -> dict[str, object]:
    size = job.bench_size
    iterations = size.iterations if row.is_splatting else None
    facts = (
        job.study, size.name, size.voxels, size.pixels, iterations, job.axis, protocol, row.label, acquisition
    )
    paper = published(row.label, job.paper_column(protocol)) if acquisition == FLY else None
    numbers = {name: summary.mean.get(name) for name in METRICS}
    spreads = {f"{name}_spread": summary.spread.get(name) for name in METRICS}
    return {
        **dict(zip(_FACTS, facts, strict=True)),
        "volumes": summary.volumes,
        "seeds": summary.seeds,
        **numbers,
        **spreads,
        "paper_psnr_db": paper.psnr_db if paper else None,
        "paper_ssim": paper.ssim if paper else None,
    }


def _all_rows(job: BenchJob) -> list[Row]:
    """Returns the rows of a table, and the static rows of their stop-and-shoot runs. Each run comes once."""
    rows = job.chosen_rows
    return list({row.run: row for row in [*(row.static() for row in rows), *rows]}.values())
