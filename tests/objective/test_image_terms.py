"""L1 + λ(1 − SSIM): kernel, float64 twin, finite differences, scikit-image."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.metrics import structural_similarity
from tolerances import IMAGE_GRADIENT, IMAGE_VALUE, SSIM_REFERENCE, TWIN_GRADIENT

from phyradgs_cl.objective import ImageLoss, image_loss
from phyradgs_cl.objective.image_terms import C1, C2, WINDOW
from phyradgs_cl.runtime.layout import pad_rows, pitch_of, unpad_rows

SHAPES = [(24, 31), (17, 5), (1, 1), (1, 40), (33, 1), (12, 16)]
WEIGHTS = [0.0, 0.2, 1.0]


def images(shape: tuple[int, int], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A smooth measurement and a rendering beside it, nowhere nearer than 0.02 (L1 has a kink)."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: shape[0], : shape[1]]
    measured = 0.5 + 0.4 * np.sin(0.3 * u + 0.2 * v) * np.cos(0.15 * v)
    rendered = measured + rng.choice([-1, 1], shape) * rng.uniform(0.02, 0.3, shape)
    return rendered.astype(np.float32).astype(float), measured.astype(np.float32).astype(float)


def mask_of(shape: tuple[int, int], kind: str) -> np.ndarray:
    mask = np.ones(shape)
    if kind == "some":
        mask[np.random.default_rng(3).uniform(size=shape) < 0.2] = 0
        mask[shape[0] // 2 :, : shape[1] // 3] = 0
    return mask


def on_device(
    rt, rendered, measured, mask, weight: float, transmission=None, **data: float
) -> tuple[float, np.ndarray]:
    lines, width = rendered.shape
    loss = ImageLoss(rt, lines, width, pitch_of(width), weight, **data)
    arrays = [rt.upload(pad_rows(a)) for a in (rendered, measured, mask)]
    trust = None if transmission is None else rt.upload(pad_rows(transmission))
    flat = rt.download(loss.evaluate(*arrays, float(mask.sum()), trust))
    gradient = unpad_rows(flat, rendered.shape)
    assert np.count_nonzero(flat) == np.count_nonzero(gradient)  # the padding stays zero
    return loss.value(), gradient


@pytest.mark.parametrize("kind", ["all", "some"])
@pytest.mark.parametrize("weight", WEIGHTS)
@pytest.mark.parametrize("shape", SHAPES)
def test_kernel_is_its_twin(any_rt, shape, weight, kind) -> None:
    rendered, measured = images(shape)
    mask = mask_of(shape, kind)
    value, gradient = on_device(any_rt, rendered, measured, mask, weight)
    expected, by_image = image_loss(rendered, measured, mask, weight)
    assert abs(value - expected) <= IMAGE_VALUE * max(expected, 1)
    np.testing.assert_allclose(gradient, by_image, rtol=0, atol=IMAGE_GRADIENT * np.abs(by_image).max())


@pytest.mark.parametrize("kind", ["all", "some"])
@pytest.mark.parametrize("weight", WEIGHTS)
def test_twin_is_differentiated_right(finite_differences, weight, kind) -> None:
    rendered, measured = images((13, 9), 1)
    mask = mask_of((13, 9), kind)
    expected = finite_differences(lambda x: image_loss(x, measured, mask, weight)[0], rendered)
    _, gradient = image_loss(rendered, measured, mask, weight)
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=TWIN_GRADIENT * np.abs(expected).max())


@pytest.mark.parametrize("data", [{"poisson_weight": 1.0}, {"l1_weight": 0.0, "poisson_weight": 10.0}])
@pytest.mark.parametrize("kind", ["all", "some"])
@pytest.mark.parametrize("shape", SHAPES)
def test_poisson_term_is_its_twin(any_rt, shape, data, kind) -> None:
    rendered, measured = images(shape)
    mask, trust = mask_of(shape, kind), np.exp(-3 * measured)
    value, gradient = on_device(any_rt, rendered, measured, mask, 0.2, trust, **data)
    expected, by_image = image_loss(rendered, measured, mask, 0.2, transmission=trust, **data)
    assert abs(value - expected) <= IMAGE_VALUE * max(expected, 1)
    np.testing.assert_allclose(gradient, by_image, rtol=0, atol=IMAGE_GRADIENT * np.abs(by_image).max())


@pytest.mark.parametrize("data", [{"poisson_weight": 3.0}, {"l1_weight": 0.0, "poisson_weight": 10.0}])
def test_poisson_twin_is_differentiated_right(finite_differences, data) -> None:
    rendered, measured = images((13, 9), 1)
    mask, trust = mask_of((13, 9), "some"), np.exp(-3 * measured)
    more = {"transmission": trust, **data}
    expected = finite_differences(lambda x: image_loss(x, measured, mask, 0.2, **more)[0], rendered)
    _, gradient = image_loss(rendered, measured, mask, 0.2, **more)
    np.testing.assert_allclose(gradient, expected, rtol=0, atol=TWIN_GRADIENT * np.abs(expected).max())


def test_without_a_weight_transmissions_change_no_bit(rt) -> None:
    rendered, measured = images((24, 31), 2)
    mask = mask_of((24, 31), "some")
    plain = on_device(rt, rendered, measured, mask, 0.2)
    beside = on_device(rt, rendered, measured, mask, 0.2, np.full((24, 31), 7.0))
    assert plain[0] == beside[0]
    np.testing.assert_array_equal(plain[1], beside[1])
    twin = image_loss(rendered, measured, mask, 0.2)
    twin_beside = image_loss(rendered, measured, mask, 0.2, transmission=np.full((24, 31), 7.0))
    assert twin[0] == twin_beside[0]
    np.testing.assert_array_equal(twin[1], twin_beside[1])


def test_without_transmissions_a_weight_changes_no_bit(rt) -> None:
    rendered, measured = images((24, 31), 2)
    mask = mask_of((24, 31), "some")
    for loss in (
        lambda **data: on_device(rt, rendered, measured, mask, 0.2, **data),
        lambda **data: image_loss(rendered, measured, mask, 0.2, **data),
    ):
        plain, weighed = loss(), loss(poisson_weight=3.0)
        assert plain[0] == weighed[0]
        np.testing.assert_array_equal(plain[1], weighed[1])


def test_masked_pixels_pull_at_nothing(any_rt) -> None:
    rendered, measured = images((24, 31), 2)
    mask = mask_of((24, 31), "some")
    value, gradient = on_device(any_rt, rendered, measured, mask, 0.2)
    np.testing.assert_array_equal(gradient[mask == 0], 0)
    assert np.all(gradient[mask == 1] != 0)
    spoiled = np.where(mask == 0, 50.0, measured)
    value_spoiled, gradient_spoiled = on_device(any_rt, rendered, spoiled, mask, 0.2)
    assert value_spoiled == value
    np.testing.assert_array_equal(gradient_spoiled, gradient)


def test_a_frame_without_any_pixel_has_no_gradient(rt) -> None:
    rendered, measured = images((12, 16))
    value, gradient = on_device(rt, rendered, measured, np.zeros((12, 16)), 0.2)
    assert value == pytest.approx(0, abs=IMAGE_VALUE)
    np.testing.assert_array_equal(gradient, 0)


def test_equal_images_lose_nothing(rt) -> None:
    _, measured = images((24, 31))
    value, gradient = on_device(rt, measured, measured, np.ones((24, 31)), 1.0)
    assert abs(value) <= IMAGE_VALUE
    assert np.abs(gradient).max() <= IMAGE_GRADIENT


def test_ssim_is_scikit_images() -> None:
    """The same window (truncated at 5 pixels, σ 1.5), constants and population covariance, away from the borders.

    scikit-image reflects at the border and the loss pads with zeros, so that the interior is compared: the twin's
    own border is removed by comparing two losses that differ in the interior only.
    """
    rendered, measured = images((40, 44), 4)
    _, full = structural_similarity(
        rendered,
        measured,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    assert (C1, C2) == (0.01**2, 0.03**2) and WINDOW.size == 11
    border = np.ones((40, 44), bool)
    inner = (slice(10, 30), slice(10, 34))
    border[5:35, 5:39] = False
    changed = measured.copy()
    changed[inner] = rendered[inner]  # SSIM changes within 5 pixels of this: all inside the interior
    _, full_changed = structural_similarity(
        rendered,
        changed,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    np.testing.assert_array_equal(full[border], full_changed[border])
    ones = np.ones((40, 44))
    one, two = (
        image_loss(rendered, m, ones, 1.0)[0] - image_loss(rendered, m, ones, 0.0)[0]
        for m in (measured, changed)
    )
    difference = (full_changed - full)[~border].sum() / rendered.size
    assert difference > 0.05
    assert abs((one - two) - difference) <= SSIM_REFERENCE
