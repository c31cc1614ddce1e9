"""What a reconstruction may ask of the other processes that work on the same scan, and the answers of one that is alone."""

from __future__ import annotations

from typing import Any, NoReturn
from typing import Protocol as Interface

import numpy as np


class Communicator(Interface):
    """``size`` processes (ranks) with one scan. Every method but the last two is called by all of them, in one order.

    ``exchanged_bytes``: what this rank has handed over so far.
    """

    rank: int
    size: int
    local_rank: int
    local_size: int
    exchanged_bytes: int

    def add(self, values: np.ndarray) -> None:
        """Sums contiguous ``values`` over all ranks, in place: whole numbers, or numbers that are 0 on all ranks but one.

        Both are exact in any order of summation; for others there is ``exact_sum``.
        """
        ...

    def largest(self, values: np.ndarray) -> None:
        """The largest of contiguous ``values`` over all ranks, in place."""
        ...

    def any(self, flag: bool) -> bool:
        """Whether ``flag`` is set on any rank."""
        ...

    def tell(self, value: Any) -> Any:
        """Rank 0's ``value``, on every rank."""
        ...

    def join(self, values: np.ndarray) -> np.ndarray:
        """The arrays (n, ...) of all ranks joined along their first axis, in the order of the ranks."""
        ...

    def all_fail(self) -> bool:
        """Called by a rank that fails: whether all do, soon enough; then each may end in its own time."""
        ...

    def abort(self, status: int) -> NoReturn:
        """Ends all ranks at once with the exit status ``status``."""
        ...


class Alone:
    """One process: it has everything, and nobody to tell."""

    rank, size, local_rank, local_size = 0, 1, 0, 1
    exchanged_bytes = 0

    def add(self, values: np.ndarray) -> None:
        pass

    def largest(self, values: np.ndarray) -> None:
        pass

    def any(self, flag: bool) -> bool:
        return flag

    def tell(self, value: Any) -> Any:
        return value

    def join(self, values: np.ndarray) -> np.ndarray:
        return values

    def all_fail(self) -> bool:
        return True

    def abort(self, status: int) -> NoReturn:
        raise SystemExit(status)
