"""What a reconstruction may ask of the other processes that work on the same scan, and the answers of one that is alone."""

from typing import Any, NoReturn
from typing import Protocol as Interface

import numpy as np


class Communicator(Interface):
    """``size`` processes (ranks) with one scan. Every method but the last two is called by all of them, in one order.

    ``sent_bytes``: what this rank has given to sums and gathers so far.
    """

    rank: int
    size: int
    local_rank: int
    local_size: int
    sent_bytes: int

    def allreduce_sum(self, values: np.ndarray) -> None:
        """Sums contiguous ``values`` over all ranks, in place: whole numbers, or numbers that are 0 on all ranks but one.

        Both are exact in any order of summation; for others there is ``exact_sum``.
        """
        ...

    def allreduce_max(self, values: np.ndarray) -> None:
        """The largest of contiguous ``values`` over all ranks, in place."""
        ...

    def any(self, flag: bool) -> bool:
        """Whether ``flag`` is set on any rank."""
        ...

    def bcast(self, value: Any) -> Any:
        """Broadcast: rank 0's ``value``, on every rank."""
        ...

    def allgather(self, values: np.ndarray) -> np.ndarray:
        """The arrays (n, ...) of all ranks concatenated along their first axis, in the order of the ranks."""
        ...

    def all_fail(self) -> bool:
        """Called by a rank that fails: whether all do, soon enough; then each may end in its own time."""
        ...

    def abort(self, status: int) -> NoReturn:
        """Ends all ranks at once with the exit status ``status``."""
        ...


class Alone:
    """One process: it has everything, and nobody to send it to."""

    rank, size, local_rank, local_size = 0, 1, 0, 1
    sent_bytes = 0

    def allreduce_sum(self, values: np.ndarray) -> None:
        pass

    def allreduce_max(self, values: np.ndarray) -> None:
        pass

    def any(self, flag: bool) -> bool:
        return flag

    def bcast(self, value: Any) -> Any:
        return value

    def allgather(self, values: np.ndarray) -> np.ndarray:
        return values

    def all_fail(self) -> bool:
        return True

    def abort(self, status: int) -> NoReturn:
        raise SystemExit(status)
