"""Total variation: the term of splats and the maps of voxel methods, kernels against twins, twins against definitions."""

import numpy as np
import pytest
import scipy.fft
from kernel_kit import random_weights
from tolerances import FLOAT32, FLOAT64, TV_GRADIENT, TV_MAP, TV_VALUE, TWIN_GRADIENT

from phyradgs_cl.objective import TvDescent, TvProx
from phyradgs_cl.objective.dct_prox import DctProx, dct_prox
from phyradgs_cl.objective.terms import TotalVariation, total_variation
from phyradgs_cl.objective.tv import differences, tv_descent, tv_gradient, tv_prox
from phyradgs_cl.runtime.layout import pad_rows, pitch_of, unpad_rows

SHAPES = [(5, 6, 7), (4, 3, 33), (1, 8, 17), (8, 1, 5), (6, 7, 1), (1, 1, 1)]
SKEWED = (1.0, 0.5, 0.25)
STATES = [(3, 5, 6, 7), (2, 1, 8, 17), (5, 1, 1, 1), (1, 4, 3, 33)]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_kernel_of_the_term_is_its_twin(two_rt, shape) -> None:
    tv = TotalVariation(two_rt, shape, pitch_of(shape[2]))
    for volume in (random_weights(shape), np.full(shape, 2.5)):
        flat = two_rt.download(tv.evaluate(two_rt.upload(pad_rows(volume))))
        value, gradient = total_variation(volume)
        assert abs(tv.value() - value) <= TV_VALUE * value
        np.testing.assert_allclose(unpad_rows(flat, shape), gradient, rtol=0, atol=TV_GRADIENT * gradient.any())
        assert np.count_nonzero(flat) == np.count_nonzero(unpad_rows(flat, shape))


def test_the_term_is_the_mean_difference_along_every_axis(finite_differences) -> None:
    for shape in [(5, 6, 7), (2, 3, 2)]:
        volume = random_weights(shape)
        expected = sum(np.abs(np.diff(volume, axis=axis)).mean() for axis in range(3))
        assert total_variation(volume)[0] == pytest.approx(expected, rel=FLOAT64)
    for shape in [(3, 4, 5), (1, 4, 5)]:
        volume = random_weights(shape)
        expected = finite_differences(lambda x: total_variation(x)[0], volume)
        np.testing.assert_allclose(total_variation(volume)[1], expected, rtol=0, atol=TWIN_GRADIENT)


@pytest.mark.parametrize("shape", SHAPES + STATES)
@pytest.mark.parametrize("nonnegative", [True, False])
def test_proximal_kernels_are_their_twin(two_rt, shape, nonnegative) -> None:
    """Of a volume, and of states of one. No weight only clips."""
    volume, weights = random_weights(shape), SKEWED if len(shape) == 3 else (2.0, *SKEWED)
    prox, rounded = TvProx(two_rt, shape, weights), volume.astype(np.float32)
    clipped = np.maximum(rounded, 0) if nonnegative else rounded
    np.testing.assert_array_equal(prox(rounded, 0.0, 5, nonnegative=nonnegative), clipped)
    found = prox(rounded, 0.3, 12, nonnegative=nonnegative)
    expected = tv_prox(volume, 0.3, 12, nonnegative=nonnegative, axis_weights=weights)
    np.testing.assert_allclose(found, expected, rtol=0, atol=TV_MAP)


@pytest.mark.parametrize("axis_weights", [SKEWED, (3.0, 2.0, 1.0), (1.5, *SKEWED)])
def test_the_map_is_the_minimum_of_its_objective(axis_weights) -> None:
    volume, weight = random_weights((2, 4, 5, 6) if len(axis_weights) == 4 else (4, 5, 6)), 0.4

    def objective(x: np.ndarray) -> float:
        changes = differences(x, axis_weights)
        variation = np.linalg.norm(changes[-3:], axis=0).sum() + np.abs(changes[:-3]).sum()
        return 0.5 * float(((x - volume) ** 2).sum()) + weight * float(variation)

    best = tv_prox(volume, weight, 1000, nonnegative=True, axis_weights=axis_weights)
    assert best.min() >= 0
    lowest, rng = objective(best), np.random.default_rng(0)
    for length in (1e-1, 1e-2, 1e-3):
        for _ in range(20):
            other = np.maximum(best + length * rng.normal(size=volume.shape), 0)
            assert objective(other) >= lowest - 1e-6
    assert objective(np.maximum(volume, 0)) > lowest + 1


@pytest.mark.parametrize(("axis_weights", "step"), [((1.0, 1.0, 1.0), 1 / 12), ((3.0, 2.0, 1.0), 1 / 56)])
def test_total_variation_and_the_first_step_by_hand(any_rt, axis_weights, step) -> None:
    """One over 4 Σ weights², the largest step that is sure to converge: by so much two unequal neighbours approach."""
    volume = np.zeros((2, 2, 2))
    volume[1, 1, 1], volume[0, 0, 0] = 3.0, 4.0
    # backwards of the corner of 3 lie three steps of it; at the corner of 4 all three axes step at once
    for first, expected in ((1.0, 3 * 3 + 4 * np.sqrt(3)), (2.0, 3 * 4 + 4 * np.sqrt(6))):
        variation = np.linalg.norm(differences(volume, (first, 1.0, 1.0)), axis=0).sum()
        assert variation == pytest.approx(expected, rel=1e-12)
    volume = np.array([[[0.0, 1.0]]])
    found = TvProx(any_rt, volume.shape, axis_weights)(volume, 1.0, 1, nonnegative=False)
    twin = tv_prox(volume, 1.0, 1, nonnegative=False, axis_weights=axis_weights)
    for values in (found, twin):
        np.testing.assert_allclose(values, [[[step, 1 - step]]], rtol=1e-6)


def test_the_dual_goes_on_where_the_last_call_left_it(rt) -> None:
    volume = random_weights((5, 6, 7)).astype(np.float32)
    goal, prox = tv_prox(volume, 0.4, 1000, nonnegative=False), TvProx(rt, volume.shape)
    errors = [np.abs(prox(volume, 0.4, 8, nonnegative=False) - goal).max() for _ in range(6)]
    assert errors[-1] < 0.4 * errors[0]
    other = TvProx(rt, volume.shape)
    assert prox.dual.shape == (3, *volume.shape)
    other.dual = prox.dual
    once, again = (p(volume, 0.4, 8, nonnegative=False) for p in (prox, other))
    np.testing.assert_array_equal(once, again)


@pytest.mark.parametrize("shape", SHAPES)
def test_descent_kernel_is_its_twin(two_rt, shape) -> None:
    volume, flat = random_weights(shape), np.full(shape, 2.5, np.float32)
    before, descent = volume.copy(), TvDescent(two_rt, shape)
    np.testing.assert_array_equal(descent(flat, 0.1, 3), flat)
    np.testing.assert_allclose(descent.gradient(volume), tv_gradient(volume), rtol=0, atol=TV_MAP)
    np.testing.assert_allclose(descent(volume, 0.05, 5), tv_descent(volume, 0.05, 5), rtol=0, atol=TV_MAP)
    np.testing.assert_array_equal(volume, before)  # the caller keeps his


def test_descent_twin_is_differentiated_right(finite_differences) -> None:
    volume = random_weights((3, 4, 5))

    def value(x: np.ndarray) -> float:
        steps = [np.diff(x, axis=a, prepend=x.take([0], axis=a)) for a in range(3)]
        return float(np.sqrt(sum(s * s for s in steps)).sum())

    expected = finite_differences(value, volume)
    np.testing.assert_allclose(tv_gradient(volume, 1e-8), expected, rtol=0, atol=TWIN_GRADIENT)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("step, share", [(1e-6, 1 / 2), (3e-6, 3 / 4), (0.01, 1.0)])
def test_steps_of_the_size_of_rounding_count_less_in_every_unit(two_rt, unit, step, share) -> None:
    """The length of a difference is counted 1e-6 of the volume's RMS too long."""
    volume = np.zeros((1, 1, 40))
    volume[..., :20], volume[..., 20:22] = 1.0, (0.0, step / np.sqrt(2))
    for gradient in (tv_gradient(unit * volume), TvDescent(two_rt, volume.shape).gradient(unit * volume)):
        assert gradient[0, 0, 22] == pytest.approx(-share, rel=2e-4)


BLOCK_SHAPES = [(5, 6, 7), (4, 4, 33), (17, 4, 20), (9, 11, 16), (3, 8, 8), (1, 1, 1)]


@pytest.mark.parametrize("shape", BLOCK_SHAPES)
def test_the_kernel_of_cosine_blocks_is_its_twin(two_rt, shape) -> None:
    volume = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    prox, on_device = DctProx(two_rt, shape), two_rt.upload(volume)
    for turn in range(4):
        found, nonnegative = two_rt.empty(shape), turn % 2 == 0
        assert prox(on_device, 0.4, turn, nonnegative=nonnegative, out=found) is found
        expected = dct_prox(volume, 0.4, turn, nonnegative=nonnegative)
        np.testing.assert_allclose(two_rt.download(found), expected, rtol=0, atol=FLOAT32)
    np.testing.assert_array_equal(prox(volume, 0.4, turn, nonnegative=nonnegative), two_rt.download(found))
    prox(on_device, 0.4, turn, nonnegative=nonnegative, out=on_device)  # in place, the same bits
    np.testing.assert_array_equal(two_rt.download(on_device), two_rt.download(found))


def test_four_turns_are_the_mean_over_all_blocks() -> None:
    volume = np.random.default_rng(2).normal(size=(6, 5, 7))
    shrunk, count = np.zeros_like(volume), np.zeros_like(volume)
    for z, y, x in np.ndindex(3, 2, 4):
        at = np.s_[z : z + 4, y : y + 4, x : x + 4]
        values = scipy.fft.dctn(volume[at], norm="ortho")
        less = np.sign(values) * np.maximum(np.abs(values) - 0.7, 0)
        less[0, 0, 0] = values[0, 0, 0]
        shrunk[at] += scipy.fft.idctn(less, norm="ortho")
        count[at] += 1
    mean_of_turns = np.mean([dct_prox(volume, 0.7, turn, nonnegative=False) for turn in range(4)], 0)
    np.testing.assert_allclose(mean_of_turns, shrunk / count, atol=FLOAT64)
