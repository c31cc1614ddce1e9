"""Benchmarks of volumes × methods × protocols: a results file, tables and figures. They continue after any run."""

from tables.job import BenchJob, BenchProgress, plan_runs
from tables.rows import KINDS, Row, choose_rows, rows_of
from tables.run import RESULTS, remake_tables, run_bench
from tables.sizes import SIZES, BenchSize
from tables.words import listed, listed_seeds, result_text

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
]
