"""Ranks without MPI: threads of this process. What needs MPI itself is collected where it is there."""

import importlib.util
import shutil
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

MPIEXEC = Path(sys.executable).with_name("mpiexec").exists() or shutil.which("mpiexec")
collect_ignore = [] if importlib.util.find_spec("mpi4py") and MPIEXEC else ["test_mpi.py"]


_WORK = threading.Lock()  # drivers are not asked to do with several threads


class Threads:
    """A ``Communicator`` whose ranks are threads, one at work at a time; slots hold what each has brought to a call."""

    def __init__(self, rank: int, slots: list[Any], barrier: threading.Barrier) -> None:
        self.rank, self.size = rank, len(slots)
        self.local_rank, self.local_size = rank, len(slots)
        self._slots, self._barrier = slots, barrier
        self.sent_bytes = 0

    def _all(self, value: Any, nbytes: int = 0) -> list[Any]:
        self.sent_bytes += nbytes  # counted as under MPI
        self._slots[self.rank] = value
        _WORK.release()
        try:
            self._barrier.wait(60)
            everyone = list(self._slots)
            self._barrier.wait(60)
        finally:
            _WORK.acquire()
        return everyone

    def allreduce_sum(self, values: np.ndarray) -> None:
        everyone = self._all(values.copy(), values.nbytes)
        values[...] = 0
        for other in everyone[self.rank :] + everyone[: self.rank]:  # another order on every rank
            values += other

    def allreduce_max(self, values: np.ndarray) -> None:
        values[...] = np.maximum.reduce(self._all(values.copy(), values.nbytes))

    def any(self, flag: bool) -> bool:
        return any(self._all(flag, 4))

    def bcast(self, value: Any) -> Any:
        return deepcopy(self._all(value)[0])  # as what comes by MPI

    def allgather(self, values: np.ndarray) -> np.ndarray:
        return np.concatenate(self._all(values, values.nbytes))

    def all_fail(self) -> bool:
        return False

    def abort(self, status: int) -> None:
        self._barrier.abort()
        raise SystemExit(status)


def on_ranks(size: int, work: Callable[[Threads], Any]) -> list[Any]:
    """What ``work`` returns on each of ``size`` ranks; the first exception of any of them."""
    slots, barrier = [None] * size, threading.Barrier(size)

    def one(rank: int) -> Any:
        try:
            with _WORK:
                return work(Threads(rank, slots, barrier))
        except BaseException:
            barrier.abort()
            raise

    with ThreadPoolExecutor(size) as pool:
        futures = [pool.submit(one, rank) for rank in range(size)]
    errors = [error for future in futures if (error := future.exception())]
    for error in sorted(errors, key=lambda e: isinstance(e, threading.BrokenBarrierError)):
        raise error
    return [future.result() for future in futures]


@pytest.fixture(scope="session")
def ranks_of() -> Callable[[int, Callable[[Threads], Any]], list[Any]]:
    return on_ranks
