"""Sums over ranks: exact, whatever the order, the number of ranks and the range of the numbers."""

from __future__ import annotations

import numpy as np
import pytest

from phyradgs_cl.parallel import Alone, exact_sum


def parts(count: int = 12, rows: int = 13, columns: int = 501) -> list[np.ndarray]:
    """Numbers over many orders of magnitude, rows of very different size."""
    rng = np.random.default_rng(3)
    size = 10.0 ** rng.uniform(-12, 4, (rows, 1))
    return [
        (size * rng.normal(size=(rows, columns)) * 10.0 ** rng.uniform(-9, 0, (rows, columns))).astype(
            np.float32
        )
        for _ in range(count)
    ]


def test_it_is_the_sum_to_a_float_of_the_row_s_largest() -> None:
    given = parts()
    found = exact_sum(Alone(), given, given[0].shape, len(given))
    expected = np.sum(np.asarray(given, np.float64), axis=0)
    largest = np.abs(given).max(axis=(0, 2))
    assert np.all(
        np.abs(found - expected) <= np.spacing(np.abs(expected).astype(np.float32)) + 1e-10 * largest[:, None]
    )


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5])
def test_same_bits_on_any_number_of_ranks_in_any_order(ranks_of, size) -> None:
    given = parts()
    alone = exact_sum(Alone(), given[::-1], given[0].shape, len(given))

    def work(ranks) -> np.ndarray:
        return exact_sum(ranks, given[ranks.rank :: ranks.size], given[0].shape, len(given))

    for found in ranks_of(size, work):
        np.testing.assert_array_equal(found, alone)


def test_a_rank_may_have_nothing_and_numbers_may_be_zero(ranks_of) -> None:
    def work(ranks) -> np.ndarray:
        mine = [np.zeros((2, 3), np.float32)] if ranks.rank else []
        return exact_sum(ranks, mine, (2, 3), 1)

    for found in ranks_of(2, work):
        np.testing.assert_array_equal(found, 0)


def test_the_largest_floats_do_not_overflow() -> None:
    many = [np.full((1, 2), np.float32(2.0**100))] * 64
    np.testing.assert_array_equal(exact_sum(Alone(), many, (1, 2), 64), np.float32(2.0**106))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_breaks_its_row_on_every_rank(ranks_of, bad) -> None:
    def work(ranks) -> np.ndarray:
        values = np.ones((2, 3), np.float32)
        values[1, ranks.rank] = bad if ranks.rank == 1 else 1
        return exact_sum(ranks, [values], (2, 3), 2)

    for found in ranks_of(2, work):
        assert np.all(found[0] == 2)
        assert np.all(np.isnan(found[1]))
