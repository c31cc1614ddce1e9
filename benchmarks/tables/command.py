"""The command line: methods compared on volumes, as in the paper's tables."""

import argparse
from pathlib import Path

from phyradgs_cl import signals
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.commands.console import complain, say
from phyradgs_cl.progress import Ticker
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import device_wish
from tables.job import BenchJob, BenchProgress
from tables.rows import KINDS
from tables.run import RESULTS, remake_tables, run_bench
from tables.sizes import SIZES

EXAMPLE = (
    "Example: python benchmarks/tables table1 --volumes VOLUMES -o results --size S --seeds 0,1,2. Runs that the folder's "
    "results file has already are not made again: interrupt and repeat at will."
)


def parser() -> argparse.ArgumentParser:
    """Returns the parser of the command's words."""
    text = "Compares methods on volumes: a results file that grows, tables in Markdown and CSV."
    parser = argparse.ArgumentParser(prog="tables", description=text, epilog=EXAMPLE)
    kinds = "table1: all methods, 25 and 50 views; table2: PhyRadGS over M and N; phantom: the paper's sphere phantom"
    parser.add_argument("kind", choices=KINDS, help=f"{kinds} against a pseudo-truth")
    volumes = "folder of HDF5 files NAME_COUNT.h5 or NAME.h5 with a dataset /volume, each projected at its own resolution"
    parser.add_argument("--volumes", type=Path, metavar="DIR", help=f"{volumes} (default: the built-in foot and jaw)")
    output = f"folder for {RESULTS} (one line per run) and tables (default: bench-results)"
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", default=Path("bench-results"), help=output)
    sizes = "; ".join(f"{s.name}: {s.voxels}³ from {s.pixels}², {s.iterations:,} iterations" for s in SIZES.values())
    parser.add_argument("--size", choices=SIZES, help=f"{sizes} (default: S; M for phantom)")
    parser.add_argument("--names", type=_words, help="volumes, with commas (default: all)")
    parser.add_argument("--rows", type=_words, help="rows by their label, with commas; a wrong one lists all (default: all)")
    protocols = "rapid (25 views) and standard (50), with commas (default: both for table1, else rapid)"
    parser.add_argument("--protocols", type=_words, help=protocols)
    seeds = "of noise, jitter, cloud and frame order, with commas (default: 0; with --table-only all)"
    parser.add_argument("--seeds", type=_numbers, help=seeds)
    parser.add_argument("--iterations", type=int, help="of the splatting methods (default: the size's)")
    parser.add_argument("--readout", choices=AXES, default="rows", help="what is read out at one time")
    only = "make tables from the results file, of --names and --seeds or all; run nothing"
    parser.add_argument("--table-only", action="store_true", help=only)
    parser.add_argument("--device", help="as for phyradgs")
    return parser


def _words(text: str) -> list[str]:
    return [part.strip() for part in text.split(",")]


def _numbers(text: str) -> list[int]:
    return [int(part) for part in text.split(",")]


def compare_methods(asked: argparse.Namespace) -> int:
    """Runs what the words ask for, and prints the files that it wrote. Returns the exit status."""
    seeds = (0,) if asked.seeds is None else asked.seeds
    chosen = asked.names, asked.protocols, asked.rows, seeds, asked.iterations, asked.readout
    job = BenchJob(asked.kind, asked.output, asked.volumes, asked.size, *chosen)
    wish = device_wish(asked.device)
    try:
        if asked.table_only:
            written = remake_tables(job, asked.seeds)
        else:
            written = run_bench(job, lambda: Runtime(wish), BenchTicker())
    except KeyboardInterrupt:
        done = f"interrupted: finished runs are in {job.output / RESULTS}"
        remedy = "repeat the command to continue, with --table-only for their tables"
        return complain(f"{done}; {remedy}", signals.exit_status())
    for path in written:
        say(str(path))
    return 0


class BenchTicker:
    """Shows the progress of a benchmark: a counter for each run, and its result once it is done."""

    def __init__(self) -> None:
        self.title = ""
        self.ticker = Ticker("")

    def __call__(self, p: BenchProgress) -> None:
        if p.title != self.title:
            self.title = p.title
            self.ticker = Ticker(f"{p.number}/{p.runs} {p.title}: iteration")
        if p.line is not None:
            self.ticker.end_line()
            say(result_text(p))
        elif p.iterations:
            self.ticker.show(p.iteration, p.iterations)


def result_text(progress: BenchProgress) -> str:
    """Returns the result of a finished run."""
    line = progress.line or {}
    numbers = line.get("metrics")
    if numbers is None:
        found = f"failed: {line.get('error')}"
    else:
        psnr = numbers.get("psnr_db")
        found = f"PSNR {'inf' if psnr is None else format(psnr, '.2f')} dB, SSIM {numbers['ssim']:.3f}"
        found += f"{' to the truth' if 'psnr_db_pseudo' in numbers else ''}, {line['seconds']:.1f} s"
    return f"{progress.number}/{progress.runs} {progress.title}: {found}"
