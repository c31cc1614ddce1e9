"""Sums of floats that are the same bits whatever the order and the number of ranks.

Numbers are turned to whole ones of 64 bits with a power of two per row as scale, the largest for which the sum cannot
overflow: adding those is exact and associative. What a float32 has below 2⁻³⁷ of its row's largest (for 64 terms; its
last bit at 2⁻²³ is the float's own) is rounded off.
"""

from collections.abc import Sequence

import numpy as np

from phyradgs_cl.parallel.communicator import Communicator

_BITS = 62
_NOT_FINITE = 100_000  # more than any float's exponent
_BLOCK_VALUES = 1 << 20


def exact_sum(
    ranks: Communicator, parts: Sequence[np.ndarray], shape: tuple[int, int], terms: int
) -> np.ndarray:
    """Σ of all ranks' ``parts``, each of ``shape`` (rows, n) float32; ``terms`` is their number over all ranks.

    The sum (rows, n) float32 is on every rank. Rows with a number that is not finite become NaN. ``parts`` may be empty.
    """
    exponents = _largest_exponents(ranks, parts, shape[0])
    broken = exponents >= _NOT_FINITE
    shift = _BITS - max(terms - 1, 0).bit_length() - np.where(broken, 0, exponents)
    total = np.empty(shape, np.float32)
    columns = max(_BLOCK_VALUES // max(shape[0], 1), 1)
    for first in range(0, shape[1], columns):
        block = slice(first, min(first + columns, shape[1]))
        whole = np.zeros((shape[0], block.stop - first), np.int64)
        for part in parts:
            whole += as_whole(part[:, block], shift, broken)
        ranks.allreduce_sum(whole)
        total[:, block] = whole * np.ldexp(1.0, -shift)[:, None]
    total[broken] = np.nan
    return total


def as_whole(values: np.ndarray, shift: np.ndarray, broken: np.ndarray) -> np.ndarray:
    """Values (rows, n) times 2^shift (rows,), rounded, int64; 0 in rows that are broken."""
    wide = np.multiply(values, np.ldexp(1.0, shift)[:, None], dtype=np.float64)  # by a power of two: exact
    if broken.any():
        wide[broken] = 0
    return np.rint(wide, out=wide).astype(np.int64)


def _largest_exponents(ranks: Communicator, parts: Sequence[np.ndarray], rows: int) -> np.ndarray:
    """Of every row the least e with |values| < 2^e on all ranks, int64; rows that are not finite have a mark."""
    exponents = np.full(rows, -300, np.int64)
    for part in parts:
        largest = np.abs(part).max(axis=1, initial=0.0).astype(np.float64)  # NaN where there is one
        finite = np.isfinite(largest)
        found = np.frexp(np.where(finite, largest, 0.0))[1].astype(np.int64)
        found[largest == 0] = -300
        exponents = np.maximum(exponents, np.where(finite, found, _NOT_FINITE))
    ranks.allreduce_max(exponents)
    return exponents
