"""SSIM against scikit-image's, whose mirrored border is replaced by a margin of zeros."""

from importlib import import_module

import numpy as np
import pytest
from refusals import assert_refused
from skimage.metrics import structural_similarity

from phyradgs_cl.metrics import ssim, ssim_map


def _pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 1.7, (20, 24, 18))
    truth[:3] = 0  # empty slices, as air above an object
    truth[:, :, 14:] = 0
    return truth + rng.normal(0, 0.3, truth.shape), truth


def _reference_map(image: np.ndarray, truth: np.ndarray, data_range: float) -> np.ndarray:
    margin = 12  # more than the window reaches, so that mirroring only ever mirrors zeros
    window = {
        "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": data_range,
    }
    _, full = structural_similarity(np.pad(image, margin), np.pad(truth, margin), full=True, **window)
    return full[margin:-margin, margin:-margin]


def test_map_equals_scikit_image_up_to_the_border() -> None:
    result, truth = _pair()
    expected = np.stack([_reference_map(a, b, 1.3) for a, b in zip(result, truth, strict=True)])
    assert np.allclose(ssim_map(result, truth, 1.3), expected, atol=1e-10)


@pytest.mark.parametrize("data_range", [None, 1.0])
def test_volume_equals_the_mean_over_slices_that_are_not_empty(data_range: float | None) -> None:
    result, truth = _pair()
    peak = data_range or truth.max()
    means = []
    for axis in range(3):
        slices = zip(np.moveaxis(result, axis, 0), np.moveaxis(truth, axis, 0), strict=True)
        means.append(np.mean([_reference_map(a, b, peak).mean() for a, b in slices if b.any()]))
    assert ssim(result, truth, data_range) == pytest.approx(np.mean(means), abs=1e-10)


def test_laws_and_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    result, truth = _pair()
    assert ssim(truth, truth) == pytest.approx(1.0, abs=1e-12)
    full = np.abs(result) + 0.1, np.abs(truth) + 0.1  # no empty slices: then the order does not matter
    assert ssim(*full, 1.0) == pytest.approx(ssim(full[1], full[0], 1.0), rel=1e-12)
    assert ssim(result * 0.01, truth * 0.01) == pytest.approx(ssim(result, truth), rel=1e-9)
    result, truth = _pair()
    whole = ssim(result, truth)
    module = import_module("phyradgs_cl.metrics.quality")  # the package's attribute is the function
    monkeypatch.setattr(module, "_VOXELS_PER_BATCH", 700)
    assert ssim(result, truth) == pytest.approx(whole, rel=1e-13)


def test_wrong_arguments_are_refused() -> None:
    assert_refused({
        "reference: found shape": lambda: ssim(np.ones((4, 4)), np.ones((4, 4))),
        "zeros only": lambda: ssim(np.ones((4, 4, 4)), np.zeros((4, 4, 4)), 1.0),
        "result: found shape": lambda: ssim(np.ones((4, 4, 5)), np.ones((4, 4, 4))),
    })  # fmt: skip
