"""What a reconstruction asks of the other processes (ranks) that work on the same scan; shares of work; failing together."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn, Protocol

import numpy as np


class Communicator(Protocol):
    """``size`` processes (ranks) with one scan. All ranks call every method except the last two, in the same order.

    ``sent_bytes`` counts what this rank has given to sums and gathers.
    """

    rank: int
    size: int
    local_rank: int
    local_size: int
    sent_bytes: int

    def allreduce_sum(self, values: np.ndarray) -> None:
        """Sums contiguous ``values`` over all ranks, in place: integers, or numbers that are 0 on all ranks except one.

        Both are exact in any order of summation; for other values there is ``exact_sum``.
        """
        ...

    def allreduce_max(self, values: np.ndarray) -> None:
        """Replaces contiguous ``values`` by their maxima over all ranks, in place."""
        ...

    def any(self, flag: bool) -> bool:
        """True where ``flag`` is set on any rank."""
        ...

    def bcast(self, value: Any) -> Any:
        """Returns rank 0's ``value`` on every rank."""
        ...

    def allgather(self, values: np.ndarray) -> np.ndarray:
        """Concatenates the arrays (n, ...) of all ranks along their first axis, in the order of the ranks."""
        ...

    def all_fail(self) -> bool:
        """Waits, on a rank that fails, for the others: True if all ranks fail within a few seconds."""
        ...

    def abort(self, status: int) -> NoReturn:
        """Ends all ranks at once with the exit status ``status``."""
        ...


class Alone:
    """The communicator of a single process."""

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


@contextmanager
def failing_together(ranks: Communicator, report_error: Callable[[BaseException], int]) -> Iterator[None]:
    """Raises an exception of the body where all ranks have one; if only some fail, reports it and ends all ranks.

    The others would wait for a failed rank for ever. ``report_error`` prints the error and returns the exit status.
    """
    try:
        yield
    except BaseException as error:
        if not ranks.all_fail():
            ranks.abort(report_error(error))
        raise


def span(count: int, parts: int, part: int) -> range:
    """The ``part``-th of ``parts`` runs of 0 … count−1, whose lengths differ by at most one."""
    return range(part * count // parts, (part + 1) * count // parts)
