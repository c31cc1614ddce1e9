"""Nonlocal smoothing: kernels against twins, and what the weights are for."""

import itertools

import numpy as np
import pytest
from tolerances import FLOAT32, FLOAT64, LIKENESS

from phyradgs_cl.objective.nonlocal_step import OFFSETS, NonlocalStep, likeness_of, nonlocal_step

SHAPES = [(5, 6, 7), (17, 4, 20), (3, 8, 33), (2, 1, 9), (1, 2, 16), (1, 1, 1)]
WIDTH = 1.3  # of normal noise: likenesses from 0 to 1


@pytest.mark.parametrize("shape", SHAPES)
def test_the_kernels_are_their_twins(any_rt, shape) -> None:
    guide, volume = np.random.default_rng(1).normal(size=(2, *shape)).astype(np.float32)
    smooth, on_device = NonlocalStep(any_rt, shape), any_rt.upload(volume)
    np.testing.assert_array_equal(smooth(volume, 0.4), volume)  # nothing is alike yet
    for seen in (volume, guide):  # the second time in place of the first
        smooth.learn(seen, WIDTH)
    likeness = smooth.likeness
    np.testing.assert_allclose(likeness, likeness_of(guide, WIDTH), rtol=0, atol=LIKENESS)
    found = any_rt.empty(shape)
    assert smooth(on_device, 0.4, out=found) is found
    np.testing.assert_allclose(any_rt.download(found), nonlocal_step(volume, likeness, 0.4), rtol=0, atol=FLOAT32)
    np.testing.assert_array_equal(smooth(volume, 0.4), any_rt.download(found))
    smooth(on_device, 0.4, out=on_device)  # in place, the same bits
    np.testing.assert_array_equal(any_rt.download(on_device), any_rt.download(found))


def test_the_twins_are_what_defines_them() -> None:
    """Patches about both voxels, the volume's outermost ones beyond its faces; and a step by a matrix of all weights."""
    shape = 3, 4, 5
    guide, volume = np.random.default_rng(2).normal(size=(2, *shape))
    voxels = list(np.ndindex(*shape))
    alike = np.zeros((len(voxels),) * 2)
    for (m, i), (n, j) in itertools.permutations(enumerate(voxels), 2):
        if np.abs(np.subtract(i, j)).max() <= 2:
            patches = (
                [guide[tuple(np.clip(np.add(at, k), 0, np.subtract(shape, 1)))] for k in np.ndindex(3, 3, 3)]
                for at in (np.subtract(i, 1), np.subtract(j, 1))
            )
            alike[m, n] = np.exp(-np.mean(np.subtract(*patches) ** 2) / WIDTH**2)
    found = likeness_of(guide, WIDTH)
    for offset, (m, i) in itertools.product(OFFSETS, enumerate(voxels)):
        j = tuple(np.add(i, offset))
        expected = alike[m, voxels.index(j)] if j in voxels else 0
        assert found[(OFFSETS.index(offset), *i)] == pytest.approx(expected, abs=FLOAT64)
    sums = alike.sum(1)
    weights = alike / np.maximum.outer(sums, sums)
    x = volume.ravel()
    moved = x + 0.4 * (weights @ x - weights.sum(1) * x)
    np.testing.assert_allclose(nonlocal_step(volume, found, 0.4).ravel(), moved, atol=FLOAT64)


def test_the_step_is_a_symmetric_mean(any_rt) -> None:
    """⟨Wx, y⟩ = ⟨x, Wy⟩; a constant stays, and nothing leaves the range of its values with the longest step."""
    shape = 6, 5, 19
    guide, x, y = np.random.default_rng(3).normal(size=(3, *shape)).astype(np.float32)
    smooth = NonlocalStep(any_rt, shape)
    smooth.learn(guide, WIDTH)
    wx, wy = smooth(x, 1.0).astype(float), smooth(y, 1.0).astype(float)
    np.testing.assert_allclose((wx * y).sum(), (x * wy).sum(), atol=FLOAT32 * np.linalg.norm(x) * np.linalg.norm(y))
    assert x.min() <= wx.min() and wx.max() <= x.max() and wx.std() < 0.9 * x.std()
    np.testing.assert_allclose(smooth(np.full(shape, 3, np.float32), 1.0), 3, rtol=FLOAT32)


def test_noise_goes_and_an_edge_stays(any_rt) -> None:
    clean = np.zeros((8, 9, 20), np.float32)
    clean[..., 10:] = 1
    noisy = clean + 0.1 * np.random.default_rng(4).normal(size=clean.shape).astype(np.float32)
    smooth = NonlocalStep(any_rt, clean.shape)
    smooth.learn(noisy, 0.25)
    found = smooth(noisy, 1.0)
    assert np.abs(found - clean)[..., 8:12].max() < 0.3
    assert (found - clean).std() < 0.5 * (noisy - clean).std()


def test_it_holds_what_is_counted(rt) -> None:
    rt.reset_peak()
    before, volume_bytes = rt.peak_bytes, 4 * 64**3
    kept = NonlocalStep(rt, (64,) * 3)
    assert 0.75 * kept.VOLUMES < (rt.peak_bytes - before) / volume_bytes < kept.VOLUMES - 1
