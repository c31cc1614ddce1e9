"""The processes (ranks) that work on the same scan: their launch, communication and parts of the work. Failures of some end
all. Sums of floats have the same bits for any order and number of ranks.

mpi4py is imported only where several processes were launched. For a sum every row is scaled by a power of two and rounded to
integers of 64 bits, with the largest scale for which the sum cannot overflow. Adding integers is exact and associative. For
64 terms the parts of a float32 below 2⁻³⁷ of its row's largest are rounded off."""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, NoReturn

import numpy as np

from phyradgs_cl.errors import InputError

# Environment variables of each launcher for (rank, size, rank on this machine, ranks on this machine).
_NAMES = ("RANK", "SIZE", "LOCAL_RANK", "LOCAL_SIZE")
_LAUNCHERS = (
    *(tuple(f"{mpi}_COMM_WORLD_{name}" for name in _NAMES) for mpi in ("OMPI", "MV2")),
    ("PMI_RANK", "PMI_SIZE", "MPI_LOCALRANKID", "MPI_LOCALNRANKS"),
    ("PMIX_RANK", "SLURM_STEP_NUM_TASKS", "SLURM_LOCALID", "SLURM_STEP_TASKS_PER_NODE"),
)
_PATIENCE_S = 5.0  # longest time that rank 0 waits for other failing ranks
_LATER_S = 0.5  # time that each next rank waits longer, so that only one reports
_MOST_VALUES = 1 << 26  # most values in one call of MPI: before version 4, its counts end at 2³¹
_BITS = 62  # most bits of an int64 that a sum may use
_NOT_FINITE = 100_000  # number that stands for the exponent of a row that is not finite: more than any float's
_BLOCK_VALUES = 1 << 20  # most values that are summed at a time


@dataclass(frozen=True)
class Launch:
    """Rank ``rank`` of ``size`` processes, ``local_rank`` of ``local_size`` on this machine; 0 of 1 for a single process."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1


def launched(environment: Mapping[str, str] = os.environ) -> Launch:
    """Reads from the environment how mpiexec (MPICH, Open MPI, MVAPICH, Intel MPI) or srun started this process."""
    for names in _LAUNCHERS:
        rank, size, local_rank, local_size = (_count(environment.get(name)) for name in names)
        if rank is None or size is None or size < 2:
            continue
        if local_rank is None:
            local_rank = _count(environment.get("SLURM_LOCALID"))
        if local_size is None:
            local_size = _count(environment.get("SLURM_STEP_TASKS_PER_NODE"))
        on_machine = size if local_size is None else local_size
        return Launch(rank, size, rank % on_machine if local_rank is None else local_rank, on_machine)
    return Launch()


def _count(text: str | None) -> int | None:
    """Returns the count in ``text``; None for other text. SLURM writes 4(x2) for four on each of two machines."""
    number = (text or "").split("(")[0].split(",")[0]
    return int(number) if number.isdigit() else None


class Communicator:
    """``size`` processes (ranks) with one scan; this class itself is a single process.

    All ranks call every method except the last two, in the same order. ``sent_bytes`` counts what this rank has given to
    sums and gathers."""

    rank, size, local_rank, local_size = 0, 1, 0, 1
    sent_bytes = 0

    def allreduce_sum(self, values: np.ndarray) -> None:
        """Sums contiguous ``values`` over all ranks, in place: integers, or numbers that are 0 on all ranks except one.

        Both are exact in any order of summation; for other values there is ``exact_sum``."""

    def allreduce_max(self, values: np.ndarray) -> None:
        """Replaces contiguous ``values`` by their maxima over all ranks, in place."""

    def any(self, flag: bool) -> bool:
        """Returns whether ``flag`` is set on any rank."""
        return flag

    def bcast(self, value: Any) -> Any:
        """Returns rank 0's ``value`` on every rank."""
        return value

    def allgather(self, values: np.ndarray) -> np.ndarray:
        """Concatenates the arrays (n, ...) of all ranks along their first axis, in the order of the ranks."""
        return values

    def all_fail(self) -> bool:
        """Waits, on a rank that fails, for the others. Returns True if all ranks fail within a few seconds."""
        return True

    def abort(self, status: int) -> NoReturn:
        """Ends all ranks at once with the exit status ``status``."""
        raise SystemExit(status)


class Mpi(Communicator):
    """A ``Communicator`` over an mpi4py communicator."""

    def __init__(self, comm: Any, launch: Launch) -> None:
        self._comm = comm
        self._failing = comm.Dup()  # failing ranks meet here, whatever the others do
        self.rank, self.size = comm.rank, comm.size
        self.local_rank, self.local_size = launch.local_rank, launch.local_size
        self.sent_bytes = 0

    def allreduce_sum(self, values: np.ndarray) -> None:
        self._reduce(values, "SUM")

    def allreduce_max(self, values: np.ndarray) -> None:
        self._reduce(values, "MAX")

    def _reduce(self, values: np.ndarray, name: str) -> None:
        from mpi4py import MPI

        assert values.flags.c_contiguous, "a copy would be reduced, and lost"
        flat = values.reshape(-1)
        self.sent_bytes += values.nbytes
        for first in range(0, flat.size, _MOST_VALUES):
            self._comm.Allreduce(MPI.IN_PLACE, flat[first : first + _MOST_VALUES], getattr(MPI, name))

    def any(self, flag: bool) -> bool:
        flags = np.array([flag], np.int32)
        self.allreduce_max(flags)
        return bool(flags[0])

    def bcast(self, value: Any) -> Any:
        return self._comm.bcast(value, 0)

    def allgather(self, values: np.ndarray) -> np.ndarray:
        rows = np.ascontiguousarray(values)
        self.sent_bytes += rows.nbytes
        counts = self._comm.allgather(len(rows))
        width = int(np.prod(rows.shape[1:], dtype=np.int64))
        gathered = np.empty((sum(counts), *rows.shape[1:]), rows.dtype)
        self._comm.Allgatherv(rows, [gathered, [count * width for count in counts]])
        return gathered

    def all_fail(self) -> bool:
        waiting = self._failing.Ibarrier()
        deadline = time.monotonic() + _PATIENCE_S + _LATER_S * min(self.rank, 20)
        while not waiting.Test():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        return True

    def abort(self, status: int) -> NoReturn:
        self._comm.Abort(status)
        raise SystemExit(status)


@cache
def launched_ranks() -> Communicator:
    """Returns the ranks that this process was launched with, or a single process.

    Raises InputError where mpi4py is missing, or belongs to another MPI than the launcher."""
    start = launched()
    if start.size == 1:
        return Communicator()
    try:
        from mpi4py import MPI
    except ImportError as error:
        subject = f"rank {start.rank} of {start.size}"
        remedy = 'pip install "phyradgs-cl[mpi]", or start it without mpiexec'
        raise InputError(subject, "no package mpi4py", "the extra mpi", remedy) from error
    world = MPI.COMM_WORLD
    if world.size != start.size:
        remedy = "start it with the mpiexec that mpi4py was built for (with srun: --mpi=pmi2 or pmix)"
        raise InputError("mpi4py", f"{world.size} of {start.size} processes", "all of them", remedy)
    return Mpi(world, start)


@contextmanager
def failing_together(ranks: Communicator, report_error: Callable[[BaseException], int]) -> Iterator[None]:
    """Raises an exception of the body where all ranks have one; if only some fail, reports it and ends all ranks.

    The others would wait for a failed rank for ever. ``report_error`` prints the error and returns the exit status."""
    try:
        yield
    except BaseException as error:
        if not ranks.all_fail():
            ranks.abort(report_error(error))
        raise


def span(count: int, parts: int, part: int) -> range:
    """Returns the ``part``-th of ``parts`` consecutive ranges of 0 … count−1, whose lengths differ by at most one."""
    return range(part * count // parts, (part + 1) * count // parts)


def exact_sum(ranks: Communicator, parts: Sequence[np.ndarray], shape: tuple[int, int], terms: int) -> np.ndarray:
    """Sums all ranks' ``parts``, each of ``shape`` (rows, n) float32; ``terms`` counts them over all ranks.

    Returns the sum (rows, n) float32 on every rank. Rows with a non-finite number become NaN. ``parts`` may be empty."""
    exponents = _largest_exponents(ranks, parts, shape[0])
    not_finite = exponents >= _NOT_FINITE
    shift = _BITS - max(terms - 1, 0).bit_length() - np.where(not_finite, 0, exponents)
    total = np.empty(shape, np.float32)
    columns = max(_BLOCK_VALUES // max(shape[0], 1), 1)
    for first in range(0, shape[1], columns):
        block = slice(first, min(first + columns, shape[1]))
        integers = np.zeros((shape[0], block.stop - first), np.int64)
        for part in parts:
            integers += as_integers(part[:, block], shift, not_finite)
        ranks.allreduce_sum(integers)
        total[:, block] = integers * np.ldexp(1.0, -shift)[:, None]
    total[not_finite] = np.nan
    return total


def as_integers(values: np.ndarray, shift: np.ndarray, not_finite: np.ndarray) -> np.ndarray:
    """Returns values (rows, n) times 2^shift (rows,), rounded to int64; 0 in rows that are not finite."""
    wide = np.multiply(values, np.ldexp(1.0, shift)[:, None], dtype=np.float64)  # exact, as a power of two
    if not_finite.any():
        wide[not_finite] = 0
    return np.rint(wide, out=wide).astype(np.int64)


def _largest_exponents(ranks: Communicator, parts: Sequence[np.ndarray], rows: int) -> np.ndarray:
    """Returns for each row (rows,) int64 the least e with |values| < 2^e over all ranks; ``_NOT_FINITE`` where not
    finite."""
    exponents = np.full(rows, -300, np.int64)
    for part in parts:
        largest = np.abs(part).max(axis=1, initial=0.0).astype(np.float64)  # NaN where there is one
        finite = np.isfinite(largest)
        part_exponents = np.frexp(np.where(finite, largest, 0.0))[1].astype(np.int64)
        part_exponents[largest == 0] = -300
        exponents = np.maximum(exponents, np.where(finite, part_exponents, _NOT_FINITE))
    ranks.allreduce_max(exponents)
    return exponents
