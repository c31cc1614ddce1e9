"""Benchmarks of volumes × methods × protocols: a results file and tables. They continue after any run."""

from tables.job import BenchJob, plan_runs
from tables.rows import KINDS, rows_of
from tables.run import RESULTS, remake_tables, run_bench
from tables.sizes import BenchSize

__all__ = ["KINDS", "RESULTS", "BenchJob", "BenchSize", "plan_runs", "remake_tables", "rows_of", "run_bench"]
