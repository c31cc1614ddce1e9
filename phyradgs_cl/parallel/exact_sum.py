"""Sums of floats whose bits depend neither on the order nor on the number of ranks.

Every row is scaled by a power of two and rounded to integers of 64 bits, with the largest scale for which the sum cannot
overflow. Adding integers is exact and associative. For 64 terms the parts of a float32 below 2⁻³⁷ of its row's largest
are rounded off."""

from collections.abc import Sequence

import numpy as np

from phyradgs_cl.parallel.ranks import Communicator

_BITS = 62
_NOT_FINITE = 100_000  # more than any float's exponent
_BLOCK_VALUES = 1 << 20


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
    wide = np.multiply(values, np.ldexp(1.0, shift)[:, None], dtype=np.float64)  # by a power of two: exact
    if not_finite.any():
        wide[not_finite] = 0
    return np.rint(wide, out=wide).astype(np.int64)


def _largest_exponents(ranks: Communicator, parts: Sequence[np.ndarray], rows: int) -> np.ndarray:
    """Returns the least e with |values| < 2^e of every row over all ranks (int64); rows that are not finite have a mark."""
    exponents = np.full(rows, -300, np.int64)
    for part in parts:
        largest = np.abs(part).max(axis=1, initial=0.0).astype(np.float64)  # NaN where there is one
        finite = np.isfinite(largest)
        part_exponents = np.frexp(np.where(finite, largest, 0.0))[1].astype(np.int64)
        part_exponents[largest == 0] = -300
        exponents = np.maximum(exponents, np.where(finite, part_exponents, _NOT_FINITE))
    ranks.allreduce_max(exponents)
    return exponents
