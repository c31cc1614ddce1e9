"""Projections compared in 2D, bias of regions, and the figure of many columns."""

from pathlib import Path

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio
from tables.metrics import compare_projections, panels_png, regional_bias

from phyradgs_cl.errors import InputError, OutputError


def _frames() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 3, (4, 12, 14))


def test_projections_are_compared_at_true_scale_over_the_whole_stack() -> None:
    truth = _frames()
    truth[0] *= 0.1  # a faint frame: its own maximum must not become the range
    result = truth + np.random.default_rng(1).normal(0, 0.05, truth.shape)
    found = compare_projections(result, truth)
    expected = peak_signal_noise_ratio(truth, result, data_range=truth.max())
    assert found["psnr_2d_db"] == pytest.approx(expected, rel=1e-12)
    assert found["data_range_2d"] == truth.max() and 0 < found["ssim_2d"] < 1
    # a wrong gain, 1.1 p − p = 0.1 p: PSNR is 20 dB above that of p itself against its range
    alone = peak_signal_noise_ratio(truth, truth * 0, data_range=truth.max())
    assert compare_projections(1.1 * truth, truth)["psnr_2d_db"] == pytest.approx(alone + 20, rel=1e-9)
    assert compare_projections(truth, truth)["ssim_2d"] == pytest.approx(1.0)
    for shapes, subject in (((truth[1:], truth), "result"), ((truth[0], truth[0]), "reference")):
        with pytest.raises(InputError, match=f"{subject}: found shape"):
            compare_projections(*shapes)


def test_bias_of_regions_is_that_of_their_means_inside() -> None:
    labels = np.zeros((12, 12, 12), int)
    labels[2:10, 2:10, 2:6], labels[2:10, 2:10, 7:10], labels[0, 0, 0] = 1, 2, 3
    truth = np.where(labels == 1, 2.0, np.where(labels == 2, 0.5, 0.0))
    result = truth.copy()
    result[3:9, 3:9, 3:5] *= 1.1  # the region 1 without its surface
    result[4, 4, 8] -= 0.25 * 36  # one voxel of the 36 inside region 2
    found = regional_bias(result, truth, labels)
    assert found == {1: pytest.approx(0.1), 2: pytest.approx(-0.5)}
    whole = regional_bias(result, truth, labels, erosion_voxels=0)
    assert whole[1] == pytest.approx(0.1 * 72 / 256)
    with pytest.raises(InputError, match="labels: found type float64"):
        regional_bias(result, truth, labels.astype(float))
    with pytest.raises(InputError, match="labels: found shape"):
        regional_bias(result, truth, labels[1:])


def test_panels_are_drawn_and_refused(tmp_path: Path) -> None:
    image = np.eye(6)
    path = tmp_path / "panels.png"
    panels_png(path, [("truth", [image, image]), ("result", [image, 2 * image])], "title")
    assert path.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InputError, match="columns of a figure"):
        panels_png(path, [("truth", [image]), ("result", [])], "title")
    with pytest.raises(OutputError, match="missing"):
        panels_png(tmp_path / "missing" / "a.png", [("truth", [image])], "title")
