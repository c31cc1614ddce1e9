"""Columns that lie on many ranks put into one order and dealt out again, a run to each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from phyradgs_cl.parallel.communicator import Communicator


def sorted_columns(
    ranks: Communicator, key: np.ndarray, columns: np.ndarray, run_of: Callable[[int, int], range]
) -> np.ndarray:
    """This rank's run of the columns (rows, n) of all ranks, sorted by ``key`` (n,); equals stay in their order.

    ``run_of`` (number of columns, rank) is what each rank gets. Every rank sees all keys, 8 bytes each, and of the columns
    only its own.
    """
    everyone = ranks.gather(key)
    counts = ranks.gather(np.array([key.size]))
    first = int(counts[: ranks.rank].sum())
    place = np.empty(everyone.size, np.int64)
    place[np.argsort(everyone, kind="stable")] = np.arange(everyone.size)
    mine = place[first : first + key.size]
    parts, places = [], []
    for rank in range(ranks.size):
        run = run_of(everyone.size, rank)
        going = np.flatnonzero((mine >= run.start) & (mine < run.stop))
        parts.append(np.ascontiguousarray(columns[:, going]))
        places.append(mine[going][None])
    received = np.concatenate(ranks.exchange(parts), axis=1)
    order = np.argsort(np.concatenate(ranks.exchange(places), axis=1)[0])
    return np.ascontiguousarray(received[:, order])
