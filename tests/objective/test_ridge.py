"""A step down a ridge regulariser: kernels against twin, and the laws of weakly convex functions."""

import json

import numpy as np
import pytest
import scipy.ndimage
from tolerances import FLOAT32, FLOAT64

from phyradgs_cl import resource
from phyradgs_cl.objective import ridge as module
from phyradgs_cl.objective.ridge import Ridge, RidgeStep, correlated, ridge_step

SHAPES = [(5, 6, 7), (17, 5, 33), (9, 11, 16), (7, 5, 20), (3, 8, 8), (6, 4, 9), (1, 1, 1)]
SIGMA = 0.4  # of volumes of normal noise: responses before, between and beyond the knots


def any_ridge(seed: int = 0) -> Ridge:
    """Returns random numbers with filters of mean 0, ρ = 0.5 and a Lipschitz constant of some units."""
    rng = np.random.default_rng(seed)
    first, second = rng.normal(size=(4, 3, 3, 3)), rng.normal(size=(16, 4, 3, 3, 3))
    first -= first.mean((1, 2, 3), keepdims=True)
    knots = np.sort(rng.uniform(0.3, 4, (2, 16)), 0)
    slopes = rng.uniform(0.2, 1, (2, 16)) * [[4], [1]]
    wanted = 0.5 / constants(Ridge(first, second, slopes[0], knots[0], slopes[1], knots[1]))[1]
    numbers = first, second * wanted**0.5, slopes[0], knots[0], slopes[1], knots[1]
    return Ridge(*(values.astype(np.float32) for values in numbers))


def constants(ridge: Ridge, size: int = 32) -> tuple[float, float]:
    """Returns bounds of the gradient's Lipschitz constant and of ρ, from the filters' spectra at ``size``³ frequencies."""
    first, second = (np.fft.rfftn(filters, (size,) * 3, axes=(-3, -2, -1)) for filters in (ridge.first, ridge.second))
    powers = [abs((first * filters).sum(0)) ** 2 for filters in second]
    steepest = np.maximum(ridge.slope_up, ridge.slope_down)
    lipschitz, convexity = (sum(map(np.multiply, slopes, powers)).max() for slopes in (steepest, ridge.slope_down))
    return float(lipschitz), float(convexity)


def value(volume: np.ndarray, sigma: float, ridge: Ridge) -> float:
    """R of a volume: integrals of the clamps."""
    responses, total = correlated(correlated(volume[None], ridge.first[:, None]), ridge.second), 0.0
    for slope, knot in ((ridge.slope_up, ridge.knot_up), (-ridge.slope_down, ridge.knot_down)):
        inner = np.minimum(abs(responses), sigma * knot[:, None, None, None].astype(np.float64))
        total += float((slope[:, None, None, None] * inner * (abs(responses) - inner / 2)).sum())
    return total


def noise(shape: tuple[int, ...], seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_kernels_are_their_twin(two_rt, shape) -> None:
    volume, ridge = noise(shape, 1).astype(np.float32), any_ridge()
    step, on_device = RidgeStep(two_rt, shape, ridge), two_rt.upload(volume)
    for nonnegative in (True, False):
        descended = two_rt.empty(shape)
        assert step(on_device, SIGMA, 0.3, nonnegative=nonnegative, out=descended) is descended
        expected = ridge_step(volume, SIGMA, 0.3, ridge=ridge, nonnegative=nonnegative)
        np.testing.assert_allclose(two_rt.download(descended), expected, rtol=0, atol=FLOAT32)
    assert (abs(expected - volume).max() > 0.01) == (min(shape) >= 5)
    np.testing.assert_array_equal(step(volume, SIGMA, 0.3, nonnegative=False), two_rt.download(descended))
    for sigma, length in ((0.0, 0.3), (SIGMA, 0.0)):  # no noise, no change
        np.testing.assert_array_equal(step(volume, sigma, length, nonnegative=False), volume)
    scaled = step(8 * volume, 8 * SIGMA, 0.3, nonnegative=False)  # no unit: the same bits, eight times as large
    np.testing.assert_array_equal(scaled, 8 * two_rt.download(descended))
    step(on_device, SIGMA, 0.3, nonnegative=False, out=on_device)  # in place
    np.testing.assert_array_equal(two_rt.download(on_device), two_rt.download(descended))


def test_correlations_are_scipy_s_and_transposes_are_theirs() -> None:
    ridge, channels = any_ridge(), noise((4, 7, 5, 6), 3)
    responses = correlated(channels, ridge.second)
    expected = [
        sum(scipy.ndimage.correlate(x, f.astype(float), mode="constant") for x, f in zip(channels, filters, strict=True))
        for filters in ridge.second
    ]
    np.testing.assert_allclose(responses, np.array(expected)[:, 1:-1, 1:-1, 1:-1], atol=FLOAT64)
    other = noise(responses.shape, 4)
    back = module.correlated_back(other, ridge.second)
    assert np.vdot(responses, other) == pytest.approx(np.vdot(channels, back), rel=FLOAT64)


def test_the_step_goes_along_the_gradient_of_the_regulariser() -> None:
    volume, ridge, size = noise((6, 7, 8), 5), any_ridge(), 1e-6
    gradient = module.ridge_gradient(volume, SIGMA, ridge)
    for seed in range(5):
        along = noise(volume.shape, 10 + seed)
        ends = [value(volume + sign * size * along, SIGMA, ridge) for sign in (1, -1)]
        assert np.vdot(gradient, along) == pytest.approx((ends[0] - ends[1]) / (2 * size), rel=1e-6)


def test_a_step_descends_the_objective_and_spreads_volumes_by_its_convexity_at_most() -> None:
    """½‖x − v‖² + step R(x) from v on; without the falling clamps R is convex and no two volumes draw apart."""
    whole = any_ridge()
    numbers = whole.first, whole.second, whole.slope_up, whole.knot_up
    for ridge in (whole, Ridge(*numbers, np.zeros_like(whole.slope_down), whole.knot_down)):
        lipschitz, convexity = constants(ridge)
        step = 1 / lipschitz
        for seed in range(4):
            one, other = (scale * noise((9, 8, 7), seed + k) for k, scale in ((0, 2.0 ** (seed - 2)), (20, 0.5)))
            lower = ridge_step(one, SIGMA, step, ridge=ridge, nonnegative=False)
            objective = ((lower - one) ** 2).sum() / 2 + step * value(lower, SIGMA, ridge)
            assert objective < step * value(one, SIGMA, ridge)
            near, beside = (ridge_step(x, SIGMA, step, ridge=ridge, nonnegative=True) for x in (one, other))
            assert np.linalg.norm(near - beside) <= (1 + step * convexity) * np.linalg.norm(one - other)


def test_the_learned_regulariser_is_weakly_convex() -> None:
    stored, ridge = json.loads((resource("data") / "ridge.json").read_text(encoding="utf-8")), module.learned_ridge()
    lipschitz, convexity = constants(ridge, 48)
    assert convexity <= 1 and (lipschitz, convexity) == pytest.approx((stored["lipschitz"], stored["convexity"]), rel=0.01)
    sums = np.einsum("c,ic->i", ridge.first.sum((1, 2, 3)), ridge.second.sum((2, 3, 4)))
    np.testing.assert_allclose(sums, 0, atol=FLOAT32)  # every filter of the chain keeps constants
    clean = np.zeros((20, 20, 20))
    clean[4:14, 6:16, 5:15] = 1.0
    noisy = clean + 0.05 * noise(clean.shape, 6)
    errors = (ridge_step(noisy, 0.05, 1.0, ridge=ridge, nonnegative=False) - clean)[(slice(4, -4),) * 3]
    assert (errors**2).mean() < 0.5 * 0.05**2
