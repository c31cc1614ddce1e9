"""Whole reconstructions of a tiny scan: repeatable, independent of units and exposure, stoppable."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from parallel.shared_runs import small_scan
from tolerances import CLOUD_VOLUME, FLOAT64, SCALE_LAW

from phyradgs_cl.acquisition import Exact, MicroViews, Scan, Static
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import voxelise
from phyradgs_cl.optim import DensityControl
from phyradgs_cl.reconstructors.method import METHODS
from phyradgs_cl.reconstructors.result import Progress, Reconstruction
from phyradgs_cl.reconstructors.splats import method as splatting
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.splats.start import initial_cloud

pytestmark = pytest.mark.slow

CONTROL = DensityControl(every=10, start_iteration=5, threshold=1e-6)
OPTIONS = SplatOptions(motion=MicroViews(4, 2), iterations=30, gaussians=300, tv_edge=8, control=CONTROL)
phyradgs, r2 = METHODS["phyradgs"].run, METHODS["r2"].run
STEADY = replace(OPTIONS, control=DensityControl(every=0))


@pytest.fixture(scope="module")
def scan() -> Scan:
    return small_scan()


@pytest.fixture(scope="module")
def run(rt, scan) -> Callable[..., Reconstruction]:
    """A run on the scan with seed 1, made once for each options."""
    return cache(lambda options=OPTIONS, **changes: phyradgs(scan, replace(options, **changes), rt, seed=1))


def difference(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def test_same_seed_same_bits(any_rt, scan) -> None:
    one, two, other = (phyradgs(scan, replace(OPTIONS, iterations=16), any_rt, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.volume, two.volume)
    np.testing.assert_array_equal(one.gaussians.rows(), two.gaussians.rows())
    assert [r["loss"] for r in one.record] == [r["loss"] for r in two.record]
    assert one.gaussians.count > OPTIONS.gaussians  # density control has acted
    assert difference(other.volume, one.volume) > 0.01


def test_lengths_times_1024_change_no_bit_and_times_1000_nothing_else(rt, run) -> None:
    plain, large = run(), phyradgs(small_scan(1024.0), OPTIONS, rt, seed=1)
    np.testing.assert_array_equal(large.volume * np.float32(1024), plain.volume)
    np.testing.assert_allclose(large.gaussians.scale, plain.gaussians.scale * 1024, rtol=FLOAT64)
    np.testing.assert_allclose(large.gaussians.density, plain.gaussians.density / 1024, rtol=FLOAT64)
    large = phyradgs(small_scan(1000.0), STEADY, rt, seed=1)
    assert difference(large.volume * 1000, run(STEADY).volume) <= SCALE_LAW


def test_the_cloud_is_the_volume(rt, scan, run) -> None:
    """Gaussians in mm and 1/mm, voxelised on the scan's own grid, are the volume that came along."""
    result, first = run(), run(iterations=0)
    round_ones = run(replace(OPTIONS, control=DensityControl(every=0, prune_aspect=1.1)))
    assert round_ones.gaussians.count < round_ones.facts["gaussians_first"]
    for made in (result, round_ones):
        again = voxelise(rt, made.gaussians.rows(), scan.grid, cutoff_sigma=OPTIONS.cutoff_sigma)
        np.testing.assert_allclose(again, made.volume, rtol=0, atol=CLOUD_VOLUME * made.volume.max())
    assert result.grid == scan.grid and result.facts["interrupted_at"] is None
    assert result.volume.min() >= 0 and result.facts["gaussians"] == result.gaussians.count
    assert 0 < first.gaussians.count <= OPTIONS.gaussians
    assert first.record == [] and first.volume.max() > 0


def test_ctrl_c_keeps_what_there_is_and_can_go_on(rt, scan, run, monkeypatch) -> None:
    """Stopped after 8 of 30 iterations; resumed from there, the volume is that of an undisturbed run, bit for bit."""
    monkeypatch.setattr(splatting, "REPORT_EVERY", 4)
    seen: list[int] = []

    def stop_at_8(progress: Progress) -> None:
        seen.append(progress.iteration)
        if progress.iteration == 8:
            raise KeyboardInterrupt

    stopped, whole = phyradgs(scan, OPTIONS, rt, seed=1, report=stop_at_8), run()
    assert seen == [4, 8] and [r["iteration"] for r in stopped.record] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert stopped.facts["interrupted_at"] == 8 and stopped.volume.shape == scan.grid.shape
    assert np.isfinite(stopped.volume).all() and stopped.volume.max() > 0 and np.any(whole.volume != stopped.volume)
    assert whole.facts["interrupted_at"] is None and whole.state is None
    resumed = phyradgs(scan, OPTIONS, rt, seed=1, resume=stopped.state)
    np.testing.assert_array_equal(resumed.volume, whole.volume)


def test_empty_scans_end_in_empty_volumes_and_masked_pixels_have_no_say(rt, scan, masked) -> None:
    result = phyradgs(replace(scan, projections=np.zeros_like(scan.projections)), replace(STEADY, iterations=5), rt)
    assert np.all(np.isfinite(result.volume)) and result.volume.mean() < 0.05
    mask = np.zeros((6, 24, 24), np.uint8)
    mask[2, 5:9, 7:12] = 1
    one, two = (phyradgs(spoilt, OPTIONS, rt, seed=1) for spoilt in masked(scan, mask))
    np.testing.assert_array_equal(one.volume, two.volume)


def test_r2_is_affine_and_motion_matters(rt, scan, run) -> None:
    exact, affine = run(STEADY, iterations=5), r2(scan, replace(STEADY, iterations=5), rt, seed=1)
    told = [(one.facts["method"], one.facts["options"]["affine"]) for one in (exact, affine)]
    assert told == [("phyradgs", False), ("r2", True)]
    assert 1e-4 < difference(affine.volume, exact.volume) < 0.2
    assert difference(run(STEADY, motion=Static()).volume, run(STEADY, motion=MicroViews()).volume) > 0.01


def test_exact_motion_is_coarse_at_first_and_goes_on_with_the_same_bits(rt, scan) -> None:
    """One pose for each frame, one segment, then its own times; a run that is resumed in any phase knows where it was."""
    options = replace(STEADY, motion=Exact(), gaussians=100, iterations=200)
    whole = phyradgs(scan, options, rt, seed=1)
    phases = [(one["from"], one["motion"]["name"], one["motion"].get("time_error")) for one in whole.facts["motion_phases"]]
    assert phases == [(0, "static", None), (59, "exact", 0.1), (146, "exact", 0.005)]
    state = None
    for at in (50, 100, 150):

        def stop(progress: Progress, at: int = at) -> None:
            if progress.iteration >= at:
                raise KeyboardInterrupt

        part = phyradgs(scan, options, rt, seed=1, report=stop, resume=state)
        assert part.facts["interrupted_at"] == at
        state = part.state
    np.testing.assert_array_equal(phyradgs(scan, options, rt, seed=1, resume=state).volume, whole.volume)
    throughout = phyradgs(scan, replace(options, exact_from=0.0, iterations=2), rt, seed=1)
    assert len(throughout.facts["motion_phases"]) == 1


GRID = Grid((6, 7, 8), (0.1, 0.2, 0.3), (0.5, 0.0, -0.5))
SETTINGS = {"threshold": 0.2, "density_share": 0.15, "scale_bounds": (0.001, 1.0), "scale_factor": 1.0}


@pytest.fixture
def volume() -> np.ndarray:
    return np.random.default_rng(111).uniform(-0.5, 1.0, GRID.shape)


def draw(volume: np.ndarray, count: int, seed: int = 0, **changes: object):
    return initial_cloud(volume, GRID, count, rng=np.random.default_rng(seed), **(SETTINGS | changes))


def test_centres_are_occupied_voxels_and_density_their_share(volume) -> None:
    cloud = draw(volume, 50)
    assert cloud.count == 50 and len({tuple(m) for m in cloud.mean}) == 50
    near = zip(GRID.axes_mm(), cloud.mean.T[::-1], strict=True)
    index = tuple(np.abs(axis[:, None] - c).argmin(axis=0) for axis, c in near)
    expected = [axis[i] for axis, i in zip(GRID.axes_mm(), index, strict=True)]
    np.testing.assert_allclose(cloud.mean.T[::-1], expected, rtol=0, atol=FLOAT64)
    assert np.all(volume[index] > 0.2)
    np.testing.assert_allclose(cloud.density, 0.15 * volume[index], rtol=FLOAT64)
    np.testing.assert_array_equal(cloud.quaternion, np.tile([1.0, 0, 0, 0], (50, 1)))


def test_scale_is_the_rms_distance_to_the_three_nearest_and_hardly_anything_still_gives_a_cloud(volume) -> None:
    cloud = draw(volume, 40, scale_factor=0.7)
    apart = np.linalg.norm(cloud.mean[:, None] - cloud.mean[None], axis=-1)
    nearest = np.sort(apart, axis=1)[:, 1:4]
    expected = 0.7 * np.sqrt((nearest**2).mean(axis=1))
    np.testing.assert_allclose(cloud.scale, np.repeat(expected[:, None], 3, axis=1), rtol=FLOAT64)
    bounded = draw(volume, 40, scale_bounds=(0.2, 0.25))
    assert bounded.scale.min() == 0.2 and bounded.scale.max() == 0.25
    assert draw(volume, 10**6).count == int((volume > 0.2).sum())  # no more than there are voxels
    one, same, other = (draw(volume, 20, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.mean, same.mean)
    assert np.any(one.mean != other.mean)
    for occupied in (0, 1, 2):
        cloud = draw((np.arange(np.prod(GRID.shape)) < occupied).reshape(GRID.shape) * 1.0, 30)
        assert cloud.count == max(occupied, 1)
        assert np.all(np.isfinite(cloud.scale)) and np.all(cloud.scale > 0) and np.all(cloud.density > 0)
