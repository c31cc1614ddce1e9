"""What a reconstruction may ask of the other processes that work on the same scan, and the answers of one that is alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn
from typing import Protocol as Interface

import numpy as np


class Communicator(Interface):
    """``size`` processes (ranks) with one scan. Every method but the last two is called by all of them, in one order.

    ``exchanged_bytes`` and ``exchange_s``: what this rank has handed over so far, and how long it was at it, waiting for
    the others (``idle_s``, where it is measured) included.
    """

    rank: int
    size: int
    local_rank: int
    local_size: int
    exchanged_bytes: int
    exchange_s: float
    idle_s: float

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

    def gather(self, values: np.ndarray) -> np.ndarray:
        """The arrays (..., n) of all ranks joined along their last axis, in the order of the ranks."""
        ...

    def exchange(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Hands ``parts[k]`` (rows, n_k) to rank k; what the ranks have handed to this one, in their order."""
        ...

    def team(self, number: int) -> Communicator:
        """The ranks that call with the same ``number``, in their order."""
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
    exchanged_bytes, exchange_s, idle_s = 0, 0.0, 0.0

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

    def gather(self, values: np.ndarray) -> np.ndarray:
        return values

    def exchange(self, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
        return list(parts)

    def team(self, number: int) -> Alone:
        return self

    def all_fail(self) -> bool:
        return True

    def abort(self, status: int) -> NoReturn:
        raise SystemExit(status)
