"""PSNR by its definition, SSIM against scikit-image's with a margin of zeros, both together, and the figure of slices."""

from importlib import import_module

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from phyradgs_cl.errors import OutputError
from phyradgs_cl.metrics import METRICS, compare, printed, psnr, slices_png, ssim, ssim_map


def test_equals_scikit_image() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 0.8, (6, 7, 8)).astype(np.float32)
    result = truth + rng.normal(0, 0.05, truth.shape).astype(np.float32)
    for data_range in (1.0, 0.3):
        expected = peak_signal_noise_ratio(truth.astype(float), result.astype(float), data_range=data_range)
        assert psnr(result, truth, data_range) == pytest.approx(expected, rel=1e-12)
    assert psnr(result, truth) == psnr(result, truth, float(truth.max())) and psnr(truth, truth) == np.inf


def _two_stacks() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 1.7, (20, 24, 18))
    truth[:3] = 0  # empty slices, as air above an object
    truth[:, :, 14:] = 0
    return truth + rng.normal(0, 0.3, truth.shape), truth


def _reference_map(image: np.ndarray, truth: np.ndarray, data_range: float) -> np.ndarray:
    margin = 12  # more than the window reaches, so that mirroring only ever mirrors zeros
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": data_range}
    _, full = structural_similarity(np.pad(image, margin), np.pad(truth, margin), full=True, **window)
    return full[margin:-margin, margin:-margin]


@pytest.mark.parametrize("data_range", [None, 1.0])
def test_ssim_is_scikit_images_up_to_the_border_and_a_mean_over_slices_that_are_not_empty(data_range, monkeypatch) -> None:
    result, truth = _two_stacks()
    expected = np.stack([_reference_map(a, b, 1.3) for a, b in zip(result, truth, strict=True)])
    assert np.allclose(ssim_map(result, truth, 1.3), expected, atol=1e-10)
    peak, means = data_range or truth.max(), []
    for axis in range(3):
        slices = zip(np.moveaxis(result, axis, 0), np.moveaxis(truth, axis, 0), strict=True)
        means.append(np.mean([_reference_map(a, b, peak).mean() for a, b in slices if b.any()]))
    assert (whole := ssim(result, truth, data_range)) == pytest.approx(np.mean(means), abs=1e-10)
    monkeypatch.setattr(import_module("phyradgs_cl.metrics.quality"), "_VOXELS_PER_BATCH", 700)
    assert ssim(result, truth, data_range) == pytest.approx(whole, rel=1e-13)  # batches do not show


def test_compare_uses_the_references_maximum_and_metrics_are_printed_with_their_units() -> None:
    truth = np.random.default_rng(0).uniform(0, 3, (4, 12, 14))
    found, peak = compare(truth + 0.1, truth), truth.max()
    assert found == {"psnr_db": psnr(truth + 0.1, truth, peak), "ssim": ssim(truth + 0.1, truth, peak), "data_range": peak}
    assert found.keys() == {*METRICS, "data_range"}
    assert list(printed({"psnr_db": 22.126, "ssim": 1.0})) == [("PSNR", "22.13 dB"), ("SSIM", "1.0000")]
    assert list(printed({"psnr_db": "x", "ssim": None})) == []


def test_the_picture_has_three_columns_also_of_nothing_and_a_missing_folder_is_named(tmp_path) -> None:
    volume, nothing = np.random.default_rng(0).uniform(size=(6, 8, 10)).astype(np.float32), np.zeros((3, 3, 3))
    for result, truth, least in ((volume + 0.1, volume, 600), (nothing, nothing, 1)):
        slices_png(tmp_path / "a.png", result, truth, "title")
        head = (tmp_path / "a.png").read_bytes()[:24]
        assert head.startswith(b"\x89PNG\r\n\x1a\n")
        assert int.from_bytes(head[16:20], "big") >= least and int.from_bytes(head[20:24], "big") > 0
    with pytest.raises(OutputError, match="missing"):
        slices_png(tmp_path / "missing" / "a.png", nothing, nothing, "title")
