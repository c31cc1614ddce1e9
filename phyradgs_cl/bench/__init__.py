"""Benchmarks: volumes × methods × protocols to a results file, tables and figures; resumable at any run."""

from phyradgs_cl.bench.at_workers import run_bench_at_workers
from phyradgs_cl.bench.job import BenchJob, BenchProgress, plan_runs
from phyradgs_cl.bench.rows import KINDS, Row, choose_rows, rows_of
from phyradgs_cl.bench.run import RESULTS, remake_tables, run_bench
from phyradgs_cl.bench.sizes import SIZES, BenchSize
from phyradgs_cl.bench.words import listed, listed_seeds, result_text

__all__ = [
    "KINDS",
    "RESULTS",
    "SIZES",
    "BenchJob",
    "BenchProgress",
    "BenchSize",
    "Row",
    "choose_rows",
    "listed",
    "listed_seeds",
    "plan_runs",
    "remake_tables",
    "result_text",
    "rows_of",
    "run_bench",
    "run_bench_at_workers",
]
