"""Total variation: kernel, float64 twin, finite differences, and its definition."""

import numpy as np
import pytest
from kernel_kit import random_weights
from tolerances import FLOAT64, TV_GRADIENT, TV_VALUE, TWIN_GRADIENT

from phyradgs_cl.objective.terms import TotalVariation, total_variation
from phyradgs_cl.runtime.layout import pad_rows, pitch_of, unpad_rows

SHAPES = [(5, 6, 7), (4, 3, 33), (1, 8, 16), (8, 1, 5), (6, 7, 1), (1, 1, 1)]


@pytest.mark.parametrize("shape", SHAPES)
def test_kernel_is_its_twin(two_rt, shape) -> None:
    volume = random_weights(shape)
    tv = TotalVariation(two_rt, shape, pitch_of(shape[2]))
    flat = two_rt.download(tv.evaluate(two_rt.upload(pad_rows(volume))))
    value, gradient = total_variation(volume)
    assert abs(tv.value() - value) <= TV_VALUE * max(value, 1)
    np.testing.assert_allclose(unpad_rows(flat, shape), gradient, rtol=0, atol=TV_GRADIENT)
    assert np.count_nonzero(flat) == np.count_nonzero(unpad_rows(flat, shape))


def test_twin_is_the_mean_difference_along_every_axis(finite_differences) -> None:
    for shape in [(5, 6, 7), (2, 3, 2)]:
        volume = random_weights(shape)
        expected = sum(np.abs(np.diff(volume, axis=axis)).mean() for axis in range(3))
        assert total_variation(volume)[0] == pytest.approx(expected, rel=FLOAT64)
    for shape in [(3, 4, 5), (1, 4, 5)]:
        volume = random_weights(shape)
        expected = finite_differences(lambda x: total_variation(x)[0], volume)
        np.testing.assert_allclose(total_variation(volume)[1], expected, rtol=0, atol=TWIN_GRADIENT)


def test_a_constant_volume_has_none(two_rt) -> None:
    tv = TotalVariation(two_rt, (4, 5, 6), pitch_of(6))
    gradient = two_rt.download(tv.evaluate(two_rt.upload(pad_rows(np.full((4, 5, 6), 2.5)))))
    np.testing.assert_array_equal(gradient, 0)
    assert tv.value() == 0
