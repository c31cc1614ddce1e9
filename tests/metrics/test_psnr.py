"""PSNR against its definition and scikit-image."""

import numpy as np
import pytest
from refusals import assert_refused
from skimage.metrics import peak_signal_noise_ratio

from phyradgs_cl.metrics import psnr


def _pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 0.8, (6, 7, 8)).astype(np.float32)
    return truth + rng.normal(0, 0.05, truth.shape).astype(np.float32), truth


def test_equals_scikit_image() -> None:
    result, truth = _pair()
    for data_range in (1.0, 0.3):
        expected = peak_signal_noise_ratio(truth.astype(float), result.astype(float), data_range=data_range)
        assert psnr(result, truth, data_range) == pytest.approx(expected, rel=1e-12)
    assert psnr(result, truth) == psnr(result, truth, float(truth.max()))
    assert psnr(np.full((3, 4, 5), 1.1), np.ones((3, 4, 5))) == pytest.approx(20.0)
    result, truth = _pair()
    assert psnr(result * 64, truth * 64) == pytest.approx(psnr(result, truth), rel=1e-9)
    assert psnr(truth, truth) == np.inf


def test_wrong_arguments_are_refused() -> None:
    result, truth = _pair()
    assert_refused({
        "result: found shape": lambda: psnr(result[1:], truth),
        "result: found 336 NaN": lambda: psnr(result * np.nan, truth),
        "data range": lambda: psnr(result, truth * 0), "data.range": lambda: psnr(result, truth, -1.0),
        "at least one voxel": lambda: psnr(np.zeros((0, 2)), np.zeros((0, 2))),
    })  # fmt: skip
