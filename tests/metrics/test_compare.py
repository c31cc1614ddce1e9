"""3D comparison."""

import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.metrics import compare, psnr, ssim


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
