"""3D comparison."""

import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.metrics import METRICS, compare, printed, psnr, ssim


def _frames() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 3, (4, 12, 14))


def test_compare_uses_the_references_maximum_and_says_so() -> None:
    truth = _frames()
    found = compare(truth + 0.1, truth)
    assert found == {
        "psnr_db": psnr(truth + 0.1, truth, truth.max()), "ssim": ssim(truth + 0.1, truth, truth.max()),
        "data_range": truth.max(),
    }
    with pytest.raises(InputError, match="reference: found a maximum of 0"):
        compare(truth, truth * 0)


def test_every_metric_is_printed_with_its_unit() -> None:
    truth = _frames()
    assert compare(truth + 0.1, truth).keys() == {*METRICS, "data_range"}
    assert list(printed({"psnr_db": 22.126, "ssim": 1.0})) == [("PSNR", "22.13 dB"), ("SSIM", "1.0000")]
    assert list(printed({"psnr_db": "x", "ssim": None})) == []
