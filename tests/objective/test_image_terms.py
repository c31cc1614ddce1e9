"""L1 + λ(1 − SSIM): kernel, float64 twin, finite differences, scikit-image."""

import numpy as np
import pytest
from kernel_kit import assert_near
from skimage.metrics import structural_similarity
from tolerances import IMAGE_GRADIENT, IMAGE_VALUE, SSIM_REFERENCE, TWIN_GRADIENT

from phyradgs_cl.objective.terms import C1, C2, WINDOW, ImageLoss, image_loss
from phyradgs_cl.runtime.layout import pad_rows, pitch_of, unpad_rows

SHAPES = [(24, 31), (17, 5), (1, 1), (1, 40), (33, 1), (12, 16)]
# how SSIM and L1 are weighed
TERMS = [(0.0, {}), (0.2, {}), (1.0, {}), (0.2, {"l1_weight": 0.0})]


def images(shape: tuple[int, int], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A smooth measurement and a rendering beside it, nowhere nearer than 0.02 (L1 has a kink)."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: shape[0], : shape[1]]
    measured = 0.5 + 0.4 * np.sin(0.3 * u + 0.2 * v) * np.cos(0.15 * v)
    rendered = measured + rng.choice([-1, 1], shape) * rng.uniform(0.02, 0.3, shape)
    return rendered.astype(np.float32).astype(float), measured.astype(np.float32).astype(float)


def mask_of(shape: tuple[int, int], kind: str) -> np.ndarray:
    mask = np.full(shape, float(kind != "none"))
    if kind == "some":
        mask[np.random.default_rng(3).uniform(size=shape) < 0.2] = 0
        mask[shape[0] // 2 :, : shape[1] // 3] = 0
    return mask


def on_device(rt, rendered, measured, mask, weight, **data: float) -> tuple[float, np.ndarray]:
    lines, width = rendered.shape
    loss = ImageLoss(rt, lines, width, pitch_of(width), weight, **data)
    arrays = [rt.upload(pad_rows(a)) for a in (rendered, measured, mask)]
    flat = rt.download(loss.evaluate(*arrays, float(mask.sum())))
    gradient = unpad_rows(flat, rendered.shape)
    assert np.count_nonzero(flat) == np.count_nonzero(gradient)  # the padding stays zero
    return loss.value(), gradient


@pytest.mark.parametrize(("weight", "data"), TERMS, ids=str)
@pytest.mark.parametrize("shape", SHAPES)
def test_kernel_is_its_twin(two_rt, shape, weight, data) -> None:
    rendered, measured = images(shape)
    for mask in (mask_of(shape, kind) for kind in ("all", "some", "none")):
        value, gradient = on_device(two_rt, rendered, measured, mask, weight, **data)
        expected, by_image = image_loss(rendered, measured, mask, weight, **data)
        assert abs(value - expected) <= IMAGE_VALUE * max(expected, 1)
        assert_near(gradient, by_image, IMAGE_GRADIENT)


@pytest.mark.parametrize("kind", ["all", "some"])
@pytest.mark.parametrize(("weight", "data"), TERMS, ids=str)
def test_twin_is_differentiated_right(finite_differences, weight, data, kind) -> None:
    rendered, measured = images((13, 9), 1)
    mask = mask_of((13, 9), kind)
    expected = finite_differences(lambda x: image_loss(x, measured, mask, weight, **data)[0], rendered)
    assert_near(image_loss(rendered, measured, mask, weight, **data)[1], expected, TWIN_GRADIENT)


def test_masked_pixels_pull_at_nothing(any_rt) -> None:
    rendered, measured = images((24, 31), 2)
    mask = mask_of((24, 31), "some")
    value, gradient = on_device(any_rt, rendered, measured, mask, 0.2)
    assert not gradient[mask == 0].any() and gradient[mask == 1].all()
    spoilt = on_device(any_rt, rendered, np.where(mask == 0, 50.0, measured), mask, 0.2)
    assert spoilt[0] == value
    np.testing.assert_array_equal(spoilt[1], gradient)


def test_ssim_is_scikit_images() -> None:
    """The same window (truncated at 5 pixels, σ 1.5), constants and population covariance. scikit-image reflects at the
    border and the loss pads with zeros: two losses are compared that differ in the interior only."""
    rendered, measured = images((40, 44), 4)
    assert (C1, C2) == (0.01**2, 0.03**2) and WINDOW.size == 11
    border = np.ones((40, 44), bool)
    inner = (slice(10, 30), slice(10, 34))
    border[5:35, 5:39] = False
    changed = measured.copy()
    changed[inner] = rendered[inner]  # SSIM changes within 5 pixels of this: all inside the interior
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    full, full_changed = (structural_similarity(rendered, m, full=True, **window)[1] for m in (measured, changed))
    np.testing.assert_array_equal(full[border], full_changed[border])
    ones = np.ones((40, 44))
    weighed = ((image_loss(rendered, m, ones, weight)[0] for weight in (1.0, 0.0)) for m in (measured, changed))
    one, two = (ssim - l1 for ssim, l1 in weighed)
    difference = (full_changed - full)[~border].sum() / rendered.size
    assert difference > 0.05
    assert abs((one - two) - difference) <= SSIM_REFERENCE
