"""PSNR against its definition and scikit-image."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio

from phyradgs_cl.errors import InputError
from phyradgs_cl.metrics import psnr


def _pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 0.8, (6, 7, 8)).astype(np.float32)
    return truth + rng.normal(0, 0.05, truth.shape).astype(np.float32), truth


@pytest.mark.parametrize("data_range", [1.0, 0.3])
def test_equals_scikit_image(data_range: float) -> None:
    result, truth = _pair()
    expected = peak_signal_noise_ratio(truth.astype(float), result.astype(float), data_range=data_range)
    assert psnr(result, truth, data_range) == pytest.approx(expected, rel=1e-12)


def test_default_range_is_the_references_maximum() -> None:
    result, truth = _pair()
    assert psnr(result, truth) == psnr(result, truth, float(truth.max()))


def test_a_constant_error_of_a_tenth_is_20_db() -> None:
    truth = np.ones((3, 4, 5))
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0)


def test_scaling_both_changes_nothing_and_equality_is_infinite() -> None:
    result, truth = _pair()
    assert psnr(result * 64, truth * 64) == pytest.approx(psnr(result, truth), rel=1e-9)
    assert psnr(truth, truth) == np.inf


def test_wrong_arguments_are_refused() -> None:
    result, truth = _pair()
    with pytest.raises(InputError, match="result: found shape"):
        psnr(result[1:], truth)
    with pytest.raises(InputError, match="result: found 336 NaN"):
        psnr(result * np.nan, truth)
    with pytest.raises(InputError, match="data range"):
        psnr(result, truth * 0)
    with pytest.raises(InputError, match="data range"):
        psnr(result, truth, -1.0)
    with pytest.raises(InputError, match="at least one voxel"):
        psnr(np.zeros((0, 2)), np.zeros((0, 2)))
