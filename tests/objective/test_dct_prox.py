"""Shrinkage of block cosine transforms: kernel against twin, twin against what defines it."""

import numpy as np
import pytest
import scipy.fft
from tolerances import FLOAT32, FLOAT64

from phyradgs_cl.objective.dct_prox import DctProx, dct_prox

SHAPES = [(5, 6, 7), (4, 4, 33), (17, 4, 20), (9, 11, 16), (3, 8, 8), (1, 1, 1)]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_kernel_is_its_twin(two_rt, shape) -> None:
    volume = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    prox, on_device = DctProx(two_rt, shape), two_rt.upload(volume)
    for turn in range(4):
        found, nonnegative = two_rt.empty(shape), turn % 2 == 0
        assert prox(on_device, 0.4, turn, nonnegative=nonnegative, out=found) is found
        expected = dct_prox(volume, 0.4, turn, nonnegative=nonnegative)
        np.testing.assert_allclose(two_rt.download(found), expected, rtol=0, atol=FLOAT32)
    np.testing.assert_array_equal(prox(volume, 0.4, turn, nonnegative=nonnegative), two_rt.download(found))
    prox(on_device, 0.4, turn, nonnegative=nonnegative, out=on_device)  # in place, the same bits
    np.testing.assert_array_equal(two_rt.download(on_device), two_rt.download(found))


def test_four_turns_are_the_mean_over_all_blocks() -> None:
    volume = np.random.default_rng(2).normal(size=(6, 5, 7))
    shrunk, count = np.zeros_like(volume), np.zeros_like(volume)
    for z, y, x in np.ndindex(3, 2, 4):
        at = np.s_[z : z + 4, y : y + 4, x : x + 4]
        values = scipy.fft.dctn(volume[at], norm="ortho")
        less = np.sign(values) * np.maximum(np.abs(values) - 0.7, 0)
        less[0, 0, 0] = values[0, 0, 0]
        shrunk[at] += scipy.fft.idctn(less, norm="ortho")
        count[at] += 1
    mean_of_turns = np.mean([dct_prox(volume, 0.7, turn, nonnegative=False) for turn in range(4)], 0)
    np.testing.assert_allclose(mean_of_turns, shrunk / count, atol=FLOAT64)
