"""Sums over ranks: exact, whatever the order, the number of ranks and the range of the numbers."""

import numpy as np
import pytest

from phyradgs_cl.parallel import Communicator, exact_sum

pytestmark = pytest.mark.slow


def parts(count: int = 12, rows: int = 13, columns: int = 501) -> list[np.ndarray]:
    """Numbers over many orders of magnitude, rows of very different size."""
    rng = np.random.default_rng(3)
    size = 10.0 ** rng.uniform(-12, 4, (rows, 1))
    shape = (count, rows, columns)
    return list((size * rng.normal(size=shape) * 10.0 ** rng.uniform(-9, 0, shape)).astype(np.float32))


def test_it_is_the_sum_to_a_float_of_the_row_s_largest() -> None:
    given = parts()
    found = exact_sum(Communicator(), given, given[0].shape, len(given))
    expected = np.sum(np.asarray(given, np.float64), axis=0)
    largest = np.abs(given).max(axis=(0, 2))
    last_place = np.spacing(np.abs(expected).astype(np.float32))
    assert np.all(np.abs(found - expected) <= last_place + 1e-10 * largest[:, None])
    many = [np.full((1, 2), np.float32(2.0**100))] * 64  # the largest floats do not overflow
    np.testing.assert_array_equal(exact_sum(Communicator(), many, (1, 2), 64), np.float32(2.0**106))


def test_same_bits_on_any_number_of_ranks_in_any_order(ranks_of) -> None:
    given = parts()
    alone = exact_sum(Communicator(), given[::-1], given[0].shape, len(given))

    def work(ranks) -> np.ndarray:
        return exact_sum(ranks, given[ranks.rank :: ranks.size], given[0].shape, len(given))

    for size in (1, 2, 3, 4, 5):
        for found in ranks_of(size, work):
            np.testing.assert_array_equal(found, alone)


def test_a_rank_may_have_nothing_and_what_is_not_finite_breaks_its_row_on_every_rank(ranks_of) -> None:
    def work(ranks, bad: float) -> np.ndarray:
        values = np.ones((2, 3), np.float32)
        values[1, ranks.rank] = bad if ranks.rank == 1 else 1
        return exact_sum(ranks, [values], (2, 3), 2)

    for found in ranks_of(2, lambda ranks: exact_sum(ranks, [np.zeros((2, 3), np.float32)] * ranks.rank, (2, 3), 1)):
        np.testing.assert_array_equal(found, 0)
    for bad in (np.nan, np.inf, -np.inf):
        for found in ranks_of(2, lambda ranks, bad=bad: work(ranks, bad)):
            assert np.all(found[0] == 2) and np.all(np.isnan(found[1]))
