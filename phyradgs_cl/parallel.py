"""Lets several MPI processes (ranks) work on one scan: how they were launched, how they communicate and share the work.

Sums over ranks have the same bits for any order and number of ranks. Each row of values is scaled by a power of two and
rounded to 64-bit integers, whose addition is exact. The scale is the largest for which the sum cannot overflow. In a sum of
64 terms each is rounded by at most 2⁻⁵⁶ of the largest value in its row. mpi4py is imported only where mpiexec or srun
started several processes."""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any, NoReturn

import numpy as np

from phyradgs_cl.errors import InputError

# Each launcher's environment variables: rank, number of ranks, rank on this machine, number of ranks on this machine.
_NAMES = ("RANK", "SIZE", "LOCAL_RANK", "LOCAL_SIZE")
_LAUNCHERS = (
    *(tuple(f"{mpi}_COMM_WORLD_{name}" for name in _NAMES) for mpi in ("OMPI", "MV2")),
    ("PMI_RANK", "PMI_SIZE", "MPI_LOCALRANKID", "MPI_LOCALNRANKS"),
    ("PMIX_RANK", "SLURM_STEP_NUM_TASKS", "SLURM_LOCALID", "SLURM_STEP_TASKS_PER_NODE"),
)
_PATIENCE_S = 5.0  # a failing rank 0 waits this long for the others to fail too, then ends them
_LATER_S = 0.5  # each rank up to 20 waits this much longer than the rank before, so that only one rank reports its error
_MOST_VALUES = 1 << 26  # most values in one MPI call: before MPI 4, a count of 2³¹ overflows
_BITS = 62  # number of bits of an int64 that a sum may use: all except the sign and one as a reserve
_NOT_FINITE = 100_000  # stands for the exponent of a row with NaN or infinity: larger than any float's exponent
_BLOCK_VALUES = 1 << 20  # ``exact_sum`` sums about this many values at a time, to hold few 64-bit integers in memory


@dataclass(frozen=True)
class Launch:
    """This process's number ``rank`` among all ``size`` ones, and ``local_rank`` among the ``local_size`` on its machine."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    local_size: int = 1


def launched(environment: Mapping[str, str] = os.environ) -> Launch:
    """Reads from environment variables how mpiexec (MPICH, Open MPI, MVAPICH, Intel MPI) or srun launched this process.
    Without either, the process has rank 0 of 1."""
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
    """Returns the number at the start of ``text``, or None. SLURM writes 4(x2) for two machines with four processes each."""
    number = (text or "").split("(")[0].split(",")[0]
    return int(number) if number.isdigit() else None


class Communicator:
    """Communication among the ``size`` processes (ranks) of a run. This base class stands for a single process.

    All ranks must call the methods in the same order, except ``all_fail`` and ``abort``. ``sent_bytes``: bytes of the arrays
    that this rank has given to sums, maxima and gathers."""

    rank, size, local_rank, local_size = 0, 1, 0, 1
    sent_bytes = 0

    def allreduce_sum(self, values: np.ndarray) -> None:
        """Sums contiguous ``values`` over all ranks, in place. They must be integers, or 0 on all ranks except one.

        Such sums are exact in any order. For other values take ``exact_sum``."""

    def allreduce_max(self, values: np.ndarray) -> None:
        """Replaces contiguous ``values`` by their maxima over all ranks, in place."""

    def any(self, flag: bool) -> bool:
        """Returns whether ``flag`` is True on any rank."""
        return flag

    def bcast(self, value: Any) -> Any:
        """Returns rank 0's ``value`` on every rank."""
        return value

    def allgather(self, values: np.ndarray) -> np.ndarray:
        """Concatenates the arrays (n, ...) of all ranks along their first axis, in the order of the ranks."""
        return values

    def all_fail(self) -> bool:
        """Waits, in a rank that fails, for all others to fail too: 5 s in rank 0, 15 s at most. Returns whether all do."""
        return True

    def abort(self, status: int) -> NoReturn:
        """Ends all ranks at once with the exit status ``status``."""
        raise SystemExit(status)


class Mpi(Communicator):
    """A ``Communicator`` over an mpi4py communicator."""

    def __init__(self, comm: Any, launch: Launch) -> None:
        self._comm = comm
        self._failing = comm.Dup()  # only failing ranks use this copy, so calls of the other ranks do not interfere
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
    """Returns the ``Communicator`` of the ranks that this process was launched with, or of a single process.

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
    """Lets an exception of the body pass if all ranks have one. If only some have one, reports it and ends all ranks,
    because the others would wait for ever.

    ``report_error`` prints the error and returns the exit status."""
    try:
        yield
    except BaseException as error:
        if not ranks.all_fail():
            ranks.abort(report_error(error))
        raise


def span(count: int, parts: int, part: int) -> range:
    """Divides 0 … count−1 into ``parts`` ranges whose lengths differ by one at most, and returns range number ``part``."""
    return range(part * count // parts, (part + 1) * count // parts)


def exact_sum(ranks: Communicator, parts: Sequence[np.ndarray], shape: tuple[int, int], terms: int) -> np.ndarray:
    """Sums the ``parts`` of all ranks, arrays (rows, n) float32. Returns the sum (rows, n) float32 on every rank.

    terms: the number of arrays over all ranks. ``parts`` may be empty. A row with NaN or infinity becomes NaN."""
    exponents = _largest_exponents(ranks, parts, shape[0])
    not_finite = exponents >= _NOT_FINITE
    shift = _BITS - max(terms - 1, 0).bit_length() - np.where(not_finite, 0, exponents)
    total = np.empty(shape, np.float32)
    columns = max(_BLOCK_VALUES // max(shape[0], 1), 1)
    for first in range(0, shape[1], columns):
        block = slice(first, min(first + columns, shape[1]))
        integers = np.zeros((shape[0], block.stop - first), np.int64)
        for part in parts:
            # the product is exact, because the factor is a power of two
            scaled = np.multiply(part[:, block], np.ldexp(1.0, shift)[:, None], dtype=np.float64)
            scaled[not_finite] = 0
            integers += np.rint(scaled, out=scaled).astype(np.int64)
        ranks.allreduce_sum(integers)
        total[:, block] = integers * np.ldexp(1.0, -shift)[:, None]
    total[not_finite] = np.nan
    return total


def _largest_exponents(ranks: Communicator, parts: Sequence[np.ndarray], rows: int) -> np.ndarray:
    """Returns, for each row of the ``parts`` (rows, n) of all ranks, the least e ≥ −300 with |values| < 2^e, (rows,) int64;
    ``_NOT_FINITE`` for a row with NaN or infinity."""
    exponents = np.full(rows, -300, np.int64)
    for part in parts:
        largest = np.abs(part).max(axis=1, initial=0.0).astype(np.float64)  # NaN for a row with a NaN
        finite = np.isfinite(largest)
        part_exponents = np.frexp(np.where(finite, largest, 0.0))[1].astype(np.int64)
        part_exponents[largest == 0] = -300
        exponents = np.maximum(exponents, np.where(finite, part_exponents, _NOT_FINITE))
    ranks.allreduce_max(exponents)
    return exponents
