"""The Markdown of a benchmark's tables: means of every row."""

from collections.abc import Callable, Sequence

from tables.case import FLY, STILL
from tables.job import PHANTOM, BenchJob
from tables.published import published
from tables.results import Line
from tables.rows import Row
from tables.summary import REFERENCE, Summary, lines_of_run, summarise

Cell = Callable[[Summary], str]


def markdown(job: BenchJob, lines: Sequence[Line]) -> str:
    """Returns a block for each protocol: the means of every row."""
    size = job.bench_size
    text = [
        f"# {_TITLES[job.kind]}: {size.voxels}³ voxels, {size.pixels}² pixels", "", *_notes(job, lines), ""
    ]
    for protocol in job.chosen_protocols:
        block = [line for line in lines if line["protocol"] == protocol]
        if block:
            text += [f"## {protocol}: {block[0]['views']} views", "", *_means(job, protocol, block), ""]
    return "\n".join(text)


_TITLES = {
    "table1": "Table 1, methods",
    "table2": "Table 2, strips M and sub-intervals N",
    "phantom": "Sphere phantom",
}


def _number(name: str, digits: int, factor: float = 1.0) -> Cell:
    def cell(summary: Summary) -> str:
        if name not in summary.mean:
            return "–"
        spread = f" ± {factor * summary.spread[name]:.{digits}f}" if name in summary.spread else ""
        return f"{factor * summary.mean[name]:.{digits}f}{spread}"

    return cell


_SYNTHETIC_COLUMNS: dict[str, Cell] = {
    "PSNR (dB)": _number("psnr_db", 2),
    "SSIM": _number("ssim", 3),
    "2D PSNR (dB)": _number("psnr_2d_db", 2),
    "2D SSIM": _number("ssim_2d", 3),
    "processor s": _number("processor_s", 1),
}
_PHANTOM_COLUMNS: dict[str, Cell] = {
    "PSNR to pseudo-truth (dB)": _number("psnr_db_pseudo", 2),
    "SSIM": _number("ssim_pseudo", 3),
    "PSNR to truth (dB)": _number("psnr_db", 2),
    "SSIM to truth": _number("ssim", 3),
    "2D PSNR (dB)": _number("psnr_2d_db", 2),
    "out of round (%)": _number("roundness", 1, 100),
    "RMS (%)": _number("roundness_rms", 1, 100),
    "shift (mm)": _number("centre_shift_mm", 2),
    "rise (mm)": _number("edge_rise_mm", 2),
    "bias balls (%)": _number("bias_balls", 1, 100),
    "bias holder (%)": _number("bias_holder", 1, 100),
    "processor s": _number("processor_s", 1),
}


def _means(job: BenchJob, protocol: str, lines: Sequence[Line]) -> list[str]:
    columns = _PHANTOM_COLUMNS if job.study == PHANTOM else _SYNTHETIC_COLUMNS
    heads = ["method", *columns, "stop-and-shoot PSNR / SSIM", "paper PSNR / SSIM"]
    text = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    most = len({line["volume"] for line in lines})
    for name in ("truth", "pseudo-truth"):
        summary = summarise(lines_of_run(lines, protocol, name, REFERENCE))
        if summary is not None:
            text.append(_row_text([name, *(cell(summary) for cell in columns.values()), "", ""]))
    for row in job.chosen_rows:
        cells = _row_cells(job, row, protocol, lines, columns, most)
        text.append(_row_text([*cells, _paper_cell(row.label, job.paper_column(protocol))]))
    return text


def _row_cells(
    job: BenchJob, row: Row, protocol: str, lines: Sequence[Line], columns: dict[str, Cell], most: int
) -> list[str]:
    moving = lines_of_run(lines, protocol, row.run, FLY)
    volumes = {line["volume"] for line in moving}
    static = lines_of_run(lines, protocol, row.static().run, STILL)
    summary = summarise(moving)
    still = summarise([line for line in static if line["volume"] in volumes or not volumes])
    label = row.label
    if summary is None and (lacks := row.lacks(job.bench_size.voxels)):
        label += f" ({lacks})"
    if summary is not None and summary.volumes < most:
        label += f" ({summary.volumes} of {most} volumes)"
    cells = [cell(summary) if summary is not None else "–" for cell in columns.values()]
    bound = _both(still) if still is not None else "–"
    if still is not None and summary is not None and still.volumes < summary.volumes:
        bound += f" ({still.volumes} of {most} volumes)"
    return [label, *cells, bound]


def _both(summary: Summary) -> str:
    return f"{_number('psnr_db', 2)(summary)} / {_number('ssim', 3)(summary)}"


def _paper_cell(label: str, column: str) -> str:
    cell = published(label, column)
    return f"{cell.psnr_db:.2f} / {cell.ssim:.3f}" if cell is not None else ""


def _row_text(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _notes(job: BenchJob, lines: Sequence[Line]) -> list[str]:
    size = job.bench_size
    seeds = sorted({line["seed"] for line in lines})
    last = lines[-1]
    machines = sorted({f"{line['device']} ({line['platform']})" for line in lines})
    return [
        f"Readout along {job.axis}. Seeds {', '.join(map(str, seeds))}: numbers are means over volumes, ± is the standard "
        "deviation over seeds of the mean over those volumes that were run with all of them. What the scans and columns "
        "are: docs/benchmarks.md; the sphere phantom: docs/results/quality.md.",
        "",
        f"All splatting rows start with {job.gaussians:,} Gaussians (or one for every voxel that attenuates, where "
        f"those are fewer) and run {size.iterations:,} iterations of one frame each.",
        "",
        f"Device {', '.join(machines)}; phyradgs-cl {last['version']}, Python {last['python']}, NumPy {last['numpy']}, "
        f"pyopencl {last['pyopencl']}, PoCL {last['pocl'] or 'none'}.",
    ]
