"""Ranks of an MPI launch through mpi4py, which is imported here and only when it is needed."""

import time
from functools import lru_cache
from typing import Any, NoReturn

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.parallel.communicator import Alone, Communicator
from phyradgs_cl.parallel.launch import Launch, launched

_PATIENCE_S, _LATER_S = (
    5.0,
    0.5,
)  # of rank 0, and how much later each next one gives up: one alone is to speak
_MOST_VALUES = 1 << 26  # of one call: counts of MPI before its version 4 end at 2³¹


@lru_cache(maxsize=1)
def launched_ranks(launch: Launch | None = None) -> Communicator:
    """The ranks that this process was launched with, always the same; ``Alone``, without mpi4py, where it was not.

    Raises InputError where mpi4py is missing, or belongs to another MPI than the launcher.
    """
    found = launched() if launch is None else launch
    if found.size == 1:
        return Alone()
    try:
        from mpi4py import MPI
    except ImportError as error:
        subject = f"rank {found.rank} of {found.size}"
        remedy = 'pip install "phyradgs-cl[mpi]", or start it without mpiexec'
        raise InputError(subject, "no package mpi4py", "the extra mpi", remedy) from error
    world = MPI.COMM_WORLD
    if world.size != found.size:
        remedy = "start it with the mpiexec that mpi4py was built for (with srun: --mpi=pmi2 or pmix)"
        raise InputError("mpi4py", f"{world.size} of {found.size} processes", "all of them", remedy)
    return Mpi(world, found)


class Mpi:
    """A ``Communicator`` over an mpi4py communicator."""

    def __init__(self, comm: Any, launch: Launch) -> None:
        self._comm = comm
        self._failing = comm.Dup()  # where those who fail meet, whatever the others are at
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
