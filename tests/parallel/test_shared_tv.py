"""Total variation in slabs: the bits of the whole volume, however many ranks there are, thin slabs and empty ones too."""

from __future__ import annotations

import numpy as np
import pytest

from phyradgs_cl.objective import TvDescent, TvProx
from phyradgs_cl.reconstructors.shared_tv import SlabDescent, SlabProx, tv_descent_for, tv_prox_for
from phyradgs_cl.runtime import Runtime

WEIGHTS = (1.0, 0.5, 1.0)


@pytest.fixture
def volume() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(17, 9, 11)).astype(np.float32)


def mapped(rt: Runtime, volume: np.ndarray) -> list[np.ndarray]:
    """Three maps, each from the last one's dual, which is read and set in between."""
    prox = tv_prox_for(rt, volume.shape, WEIGHTS, 3)
    first = prox(volume, 0.4, 3, nonnegative=True)
    second = prox(volume + first, 0.3, 2, nonnegative=False)
    dual = prox.dual
    prox.dual = dual * np.float32(0.5)
    return [first, second, dual, prox(volume, 0.2, 3, nonnegative=True)]


@pytest.mark.parametrize("size", [2, 3, 7, 20])
def test_a_proximal_map_in_slabs_has_the_bits_of_the_whole(rt, ranks_of, volume, size) -> None:
    assert isinstance(tv_prox_for(rt, volume.shape, WEIGHTS, 3), TvProx)
    expected = mapped(rt, volume)
    for found in ranks_of(size, lambda ranks: mapped(Runtime(ranks=ranks), volume)):
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("size", [2, 3, 20])
def test_descent_in_slabs_is_that_of_the_whole(rt, ranks_of, volume, size) -> None:
    assert isinstance(tv_descent_for(rt, volume.shape), TvDescent)
    expected = tv_descent_for(rt, volume.shape)(volume, 0.3, 4)
    for found in ranks_of(
        size, lambda ranks: tv_descent_for(Runtime(ranks=ranks), volume.shape)(volume, 0.3, 4)
    ):
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_no_rank_has_the_whole_on_its_device(ranks_of, volume) -> None:
    deep = np.repeat(volume, 8, axis=0)

    def most(ranks) -> tuple[int, int]:
        rt = Runtime(ranks=ranks)
        prox, descent = tv_prox_for(rt, deep.shape, WEIGHTS, 3), tv_descent_for(rt, deep.shape)
        assert isinstance(prox, SlabProx) and isinstance(descent, SlabDescent)
        return rt.peak_bytes, deep.nbytes

    for held, whole in ranks_of(4, most):
        assert held <= 0.4 * 10 * whole
