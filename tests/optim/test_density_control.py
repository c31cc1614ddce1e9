"""Clone, split, prune: who is chosen, what mass and moments they get, and that the seed decides all else."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tolerances import ADAM_KERNEL, ADAM_SECOND_MOMENT, ADAM_TEXTBOOK, FLOAT32, FLOAT64

from phyradgs_cl.fields import Activation
from phyradgs_cl.optim import DensityControl, DeviceAdam, Population, Rates, adam_step, control_density, prune

ACTIVATION = Activation(0.01, 0.5)
CONTROL = DensityControl(threshold=1.0, split_scale=0.2, prune_density=1e-3)
BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
SMALL, LARGE = 0.05, 0.4


@pytest.fixture
def population() -> Population:
    """Five Gaussians, 0 to 2 small, 3 and 4 large, centres sorted by height, moments that name their owner."""
    rows = np.zeros((11, 5))
    rows[:3] = np.array([[0.1, -0.2, 0.3, 0.0, 0.2], [0.1, 0.3, -0.3, 0.1, 0.0], [-0.4, -0.2, 0.0, 0.2, 0.4]])
    rows[3:6] = np.array([SMALL] * 3 + [LARGE] * 2)
    rows[6] = 1.0
    rows[10] = [1.1, 2.0, 3.6, 4.0, 5.0]
    moments = np.broadcast_to(np.arange(1.0, 6.0), (2, 11, 5)).copy()
    return Population(ACTIVATION.invert(rows), moments)


def run(population, statistic, control=CONTROL, seed: int = 0, box: np.ndarray = BOX) -> Population:
    rng = np.random.default_rng(seed)
    return control_density(population, np.array(statistic, float), ACTIVATION, control, box, rng)


def test_below_the_threshold_nothing_changes_but_the_order(population) -> None:
    grown = run(population, [0.99] * 5)
    np.testing.assert_array_equal(grown.raw, population.raw)
    np.testing.assert_array_equal(grown.moments, population.moments)
    order = np.array([3, 0, 4, 2, 1])
    pruned = prune(population.take(order), ACTIVATION, CONTROL, BOX)
    np.testing.assert_array_equal(pruned.raw, population.raw)
    np.testing.assert_array_equal(pruned.moments, population.moments)


def test_what_lies_on_a_bound_is_chosen_and_kept(population) -> None:
    """At the threshold: chosen. As large as the split's scale: cloned. On the box, at the least density: kept."""
    rows = ACTIVATION.apply(population.raw)
    control = replace(CONTROL, split_scale=float(rows[3, 3]), prune_density=float(rows[10, 0]))
    box = np.array([rows[:3].min(1), rows[:3].max(1)])
    assert prune(population, ACTIVATION, control, box).count == 5
    grown = run(population, [0, 0, 0, 1.0, 0], control, box=10 * BOX)
    assert grown.count == 6
    assert np.isclose(ACTIVATION.apply(grown.raw)[3], LARGE).sum() == 3  # no child is smaller


def test_a_clone_shares_place_shape_and_mass_and_a_split_gives_two_smaller_halves_from_within(population) -> None:
    grown = run(population, [0, 2, 0, 0, 0])
    pair = np.flatnonzero(np.isclose((rows := ACTIVATION.apply(grown.raw))[2], -0.2))
    assert grown.count == 6 and pair.size == 2
    np.testing.assert_allclose(rows[:3, pair], np.array([[-0.2], [0.3], [-0.2]]) * np.ones(2), rtol=FLOAT64)
    np.testing.assert_allclose(rows[3:6, pair], SMALL, rtol=FLOAT64)
    np.testing.assert_allclose(rows[10, pair], 1.0, rtol=FLOAT64)  # half of 2 each
    assert rows[10].sum() == pytest.approx(15.7, rel=FLOAT64)
    assert sorted(grown.moments[0, 0, pair]) == [0.0, 2.0]  # the old one keeps its moments, the new one has none
    grown = run(population, [0, 0, 0, 2, 0])
    rows, children = ACTIVATION.apply(grown.raw), np.flatnonzero(np.all(grown.moments == 0, axis=(0, 1)))
    assert grown.count == 6 and children.size == 2
    np.testing.assert_allclose(rows[3:6, children], LARGE / CONTROL.split_factor, rtol=FLOAT64)
    np.testing.assert_allclose(rows[10, children], 2.0, rtol=FLOAT64)  # half of 4 each
    assert not np.any(np.isclose(rows[10], 4.0))  # the parent is gone
    assert np.all(np.abs(rows[:3, children] - np.array([[0.0], [0.1], [0.2]])) < 5 * LARGE)
    assert np.ptp(rows[0, children]) > 0


def test_children_are_drawn_from_the_parent() -> None:
    """Many children of one turned ellipsoid have its covariance."""
    turn, scale, count = Rotation.from_rotvec([0.3, -0.5, 0.8]), np.array([0.4, 0.25, 0.1]), 4000
    rows = np.zeros((11, count))
    rows[3:6], rows[6:10], rows[10] = scale[:, None], turn.as_quat()[[3, 0, 1, 2]][:, None], 1.0
    population = Population(ACTIVATION.invert(rows), np.zeros((2, 11, count)))
    grown = run(population, np.full(count, 2.0), seed=4, box=100 * BOX)
    assert grown.count == 2 * count
    covariance = np.cov(ACTIVATION.apply(grown.raw)[:3])
    expected = turn.as_matrix() @ np.diag(scale**2) @ turn.as_matrix().T
    standard_error = 0.16 * np.sqrt(2 / (2 * count))
    np.testing.assert_allclose(covariance, expected, rtol=0, atol=5 * standard_error)


def test_never_more_than_allowed_and_the_strongest_first(population) -> None:
    for room in (0, 1, 2, 3):
        grown = run(population, [3, 5, 4, 0, 0], replace(CONTROL, max_gaussians=5 + room))
        assert grown.count == 5 + room
        densities = ACTIVATION.apply(grown.raw)[10]
        halved = [np.isclose(densities, d / 2).sum() == 2 for d in (2.0, 3.6, 1.1)]  # statistic 5, 4, 3
        assert halved == [room > 0, room > 1, room > 2]
    assert run(population, [1.0] * 5, replace(CONTROL, max_gaussians=7)).count == 7  # equals at the threshold
    assert run(population, [9] * 5, replace(CONTROL, max_gaussians=3)).count == 5  # a full one is left in peace


def test_the_faded_the_lost_sheets_and_needles_are_pruned_unless_they_are_wanted(population) -> None:
    for row, value, kept in [
        (10, 0.5e-3, False), (10, 2e-3, True), (0, 1.01, False), (0, 0.99, True), (1, -1.01, False),
        (2, 1.2, False)
    ]:  # fmt: skip
        rows = ACTIVATION.apply(population.raw)
        rows[row, 4] = value
        pruned = prune(Population(ACTIVATION.invert(rows), population.moments), ACTIVATION, CONTROL, BOX)
        assert pruned.count == 4 + kept, (row, value)
        assert (5.0 in pruned.moments[0, 0]) == kept, (row, value)
    rows = np.tile([[0.0], [0.0], [0.0], [0.1], [0.1], [0.1], [1.0], [0.0], [0.0], [0.0], [1.0]], 4)
    rows[3:6] = np.array([[0.1, 0.1, 0.1], [0.5, 0.5, 0.005], [0.6, 0.01, 0.01], [0.49, 0.01, 0.02]]).T
    activation, box = Activation(0.001, 1.0), np.array([[-1.0] * 3, [1.0] * 3])
    population = Population(activation.invert(rows), np.zeros((2, 11, 4)))
    for aspect, kept in ((50.0, [0, 3]), (80.0, [0, 2, 3]), (0.0, [0, 1, 2, 3])):
        found = prune(population, activation, DensityControl(prune_aspect=aspect), box)
        scales = np.sort(activation.apply(found.raw)[3:6].max(0))
        np.testing.assert_allclose(scales, np.sort(rows[3:6].max(0)[kept]), rtol=1e-6)


def test_when_it_acts_and_rates_decay_exponentially() -> None:
    control = DensityControl(every=100, start_iteration=500, stop_fraction=0.75)
    due = [i for i in range(1, 2001) if control.is_due(i, 2000)]
    assert due == list(range(600, 1500, 100))
    assert not any(replace(control, every=0).is_due(i, 2000) for i in range(1, 2001))
    rates = Rates(position=(1e-2, 1e-4), scale=(4e-3, 4e-3), rotation=(1e-3, 1e-5), density=(1.0, 0.25))
    first, middle, last = (rates.at(p) for p in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(first, [1e-2] * 3 + [4e-3] * 3 + [1e-3] * 4 + [1.0], rtol=FLOAT64)
    np.testing.assert_allclose(last, [1e-4] * 3 + [4e-3] * 3 + [1e-5] * 4 + [0.25], rtol=FLOAT64)
    np.testing.assert_allclose(middle, np.sqrt(first * last), rtol=FLOAT64)


RATES = np.array([1e-2] * 3 + [2e-2] * 3 + [5e-3] * 4 + [3e-2])


def textbook(raw: np.ndarray, gradients: list[np.ndarray]) -> np.ndarray:
    """Algorithm 1 of Kingma and Ba, bias corrections written out, ε = 1e-15."""
    theta, m, v = raw.copy(), np.zeros_like(raw), np.zeros_like(raw)
    for t, g in enumerate(gradients, start=1):
        m = 0.9 * m + 0.1 * g
        v = 0.999 * v + 0.001 * g * g
        theta = theta - RATES[:, None] * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-15)
    return theta


def test_the_kernel_is_its_twin_and_the_twin_the_textbooks(any_rt) -> None:
    """Gradients are of six decades, some of them exactly zero."""
    rng, stride, gradients = np.random.default_rng(91), 32, []
    padded = np.zeros((11, stride), np.float32)
    padded[:, :19] = raw = rng.normal(size=(11, 19)).astype(np.float32).astype(float)
    device_raw, device_moments = any_rt.upload(padded), any_rt.zeros((2, 11, stride))
    adam = DeviceAdam(any_rt, Activation(0.01, 0.5))
    theta, moments = raw, np.zeros((2, *raw.shape))
    for step in range(1, 7):
        by = np.zeros((13, stride), np.float32)
        g = rng.normal(size=(11, 19)) * 10.0 ** rng.uniform(-6, 0, (11, 19))
        by[:11, :19] = np.where(rng.uniform(size=g.shape) < 0.1, 0, g)
        gradients.append(g := by[:11, :19].astype(float))
        adam.step(device_raw, any_rt.upload(by), device_moments, stride, RATES, step)
        theta, moments = adam_step(theta, g, moments, RATES, step)
        moved = any_rt.download(device_raw)[:, :19] - raw
        np.testing.assert_allclose(moved, theta - raw, rtol=0, atol=ADAM_KERNEL * RATES.max())
    np.testing.assert_allclose(theta, textbook(raw, gradients), rtol=0, atol=ADAM_TEXTBOOK * RATES.max())
    found = any_rt.download(device_moments)[:, :, :19]
    np.testing.assert_allclose(found[0], moments[0], rtol=FLOAT32)
    np.testing.assert_allclose(found[1], moments[1], rtol=ADAM_SECOND_MOMENT)
    np.testing.assert_array_equal(any_rt.download(device_raw)[:, 19:], 0)  # padding has no gradient
