"""Error bars: two more runs on synthesised scans, the same after an interruption, and about as wide as the errors."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import assert_refused
from scipy.ndimage import gaussian_filter

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import azimuth_rad, middle_poses
from phyradgs_cl.acquisition.altered.coarse import some_frames
from phyradgs_cl.api import prepare, reconstruct, simulate, static_scan
from phyradgs_cl.detector.noise_level import noise_map
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import read_checkpoint, write_checkpoint
from phyradgs_cl.metrics import coverage
from phyradgs_cl.metrics.align import block_means
from phyradgs_cl.reconstructors import doubt
from phyradgs_cl.reconstructors.doubt import Doubter, Law, finer, fitted_law, halves, spread, widening
from phyradgs_cl.reconstructors.projected import held_out
from phyradgs_cl.reconstructors.result import DOUBT, Reconstruction, interrupted

FEW = {"method": "sirt", "iterations": 4, "report": False}
LAW = Law(1.0, 1.0, 0.0, 0.0, 0.55, 3.0)


@pytest.fixture(scope="module")
def scan(rt) -> Scan:
    return simulate("spheres", size=12, detector=24, views=8, noise="tigre", dose=1e4, device=rt)


def test_the_volume_has_the_same_bits_with_error_bars_and_these_the_same_for_one_seed(rt, scan) -> None:
    plain = reconstruct(scan, device=rt, **FEW)
    one, two, other = (reconstruct(scan, device=rt, doubt=True, seed=seed, **FEW) for seed in (0, 0, 1))
    assert plain.doubt is None and DOUBT not in plain.facts
    np.testing.assert_array_equal(one.volume, plain.volume)
    np.testing.assert_array_equal(one.doubt, two.doubt)
    assert one.doubt.shape == scan.grid.shape and (one.doubt > 0).all()
    assert not np.array_equal(one.doubt, other.doubt)


def test_error_bars_cover_a_phantom_of_closed_form_and_their_mean_is_that_of_matter_where_noise_fills_the_air(rt) -> None:
    scan = simulate("spheres", size=24, detector=32, views=24, noise="tigre", dose=1e3, device=rt)
    result = reconstruct(scan, "fdk", device=rt, report=False, doubt=True)
    matter, air, mean = scan.reference > 0.1 * scan.reference.max(), scan.reference == 0, result.facts[DOUBT]["mean_per_mm"]
    assert mean == pytest.approx(result.doubt[matter].mean(), rel=0.25) and mean > 1.3 * result.doubt[air].mean()
    covered = coverage(result.doubt, result.volume, scan.reference, result.facts[DOUBT]["multiple_95"])
    assert 0.5 < covered["within_doubt"] < 0.9 < covered["within_doubt_95"]
    assert 0.5 < covered["doubt_over_error"] < 2


def test_a_synthesised_scan_has_the_residual_of_the_scan_its_mask_and_its_hidden_pixels(rt) -> None:
    scan = simulate("jaw", noise="tigre", dose=1e4, size=20, detector=40, views=8, device=rt)
    mask = np.zeros(scan.projections.shape[1:], bool)
    mask[3, 4:9] = True
    whole = replace(scan, pixel_mask=mask)
    hidden = held_out(whole, 5.0)
    seen = replace(whole, pixel_mask=mask | hidden)
    first = reconstruct(scan, "sirt", iterations=12, device=rt, report=False)
    one, two = (Doubter(rt, seen, whole, hidden, None, 0).scan_of_run(first, number) for number in (1, 2))
    np.testing.assert_array_equal(one.valid, seen.valid)
    added, computed = ((one.projections + sign * two.projections) / 2 for sign in (-1, 1))
    signs = np.sign(np.sum(added * (scan.projections - computed) * seen.valid, axis=(1, 2)))
    own = signs[:, None, None] * (scan.projections - computed)
    np.testing.assert_allclose(added[seen.valid], own[seen.valid], atol=1e-5)
    assert {*signs} == {-1, 1}


def test_an_analytic_method_gets_every_second_frame_and_its_error_bars_have_the_true_noise(rt) -> None:
    """The mean of both volumes is about the volume of all frames, whose noise is that of half their difference."""
    usual = {"size": 24, "detector": 48, "views": 40, "exposure_deg": 4.0, "time_samples": 1, "device": rt}
    noisy, clean = simulate("spheres", noise="tigre", dose=200, **usual), simulate("spheres", **usual)
    doubter = Doubter(rt, noisy, noisy, None, None, 0, "analytic")
    even, odd = (doubter.scan_of_run(None, number) for number in (1, 2))
    np.testing.assert_array_equal(even.projections, noisy.projections[::2])
    np.testing.assert_array_equal(odd.projections, noisy.projections[1::2])
    x0, x1, x2, true = (reconstruct(one, "fdk", device=rt, report=False).volume for one in (noisy, even, odd, clean))
    law = Law(0.0, 1.0, 0.0, 0.0, 1.0, 3.0)
    assert np.sqrt(np.mean(spread(x0, x1, x2, law) ** 2)) == pytest.approx(np.std(x0 - true), rel=0.3)


def test_halves_are_of_angles_and_not_of_time(rt) -> None:
    """Opposite views that alternate, as in a half-fan, are not torn apart. Two turns of an odd number of views are two equal
    turns to each half. A helix is halved in time: its second turn sees other slices."""
    usual = {"size": 12, "detector": 16, "protocol": "static", "device": rt}
    turn, order = simulate("spheres", views=16, **usual), np.arange(16).reshape(2, 8).T.ravel()
    for scan in (turn, some_frames(turn, order)):
        even, odd = (np.sort(azimuth_rad(middle_poses(some_frames(scan, half))) % (2 * np.pi)) for half in halves(scan))
        np.testing.assert_allclose(np.diff(even), np.pi / 4, atol=1e-6)
        np.testing.assert_allclose(odd - even, np.pi / 8, atol=1e-6)
    twice = some_frames(simulate("spheres", views=15, **usual), np.tile(np.arange(15), 2))
    evens, odds = [*range(0, 15, 2)], [*range(1, 15, 2)]
    assert [half.tolist() for half in halves(twice)] == [evens + [15 + k for k in evens], odds + [15 + k for k in odds]]
    travelling = middle_poses(twice)
    travelling[:, [2, 5]] += np.linspace(-20, 20, 30)[:, None]
    helix = Scan.from_poses(twice.projections, travelling, twice.grid)
    assert [half.tolist() for half in halves(helix)] == [[*range(0, 30, 2)], [*range(1, 30, 2)]]


def test_repeated_frames_are_no_further_views_of_the_bars(rt) -> None:
    """A fifth turn over the same angles adds none; frames of a helix, and of fewer than 4 angles, all count."""
    turn = simulate("spheres", views=15, size=12, detector=16, protocol="static", device=rt)
    again = some_frames(turn, np.tile(np.arange(15), 5))
    moving = middle_poses(again)
    moving[:, [2, 5]] += np.linspace(-20, 20, 75)[:, None]
    helix, few = Scan.from_poses(again.projections, moving, again.grid), some_frames(turn, [0, 5, 0, 5, 0])
    volumes = np.random.default_rng(4).random((3, *turn.grid.shape)).astype(np.float32)
    runs = [Reconstruction(volume, turn.grid, facts={"seconds": 1.0}) for volume in volumes]
    for scan, views in ((turn, 15), (again, 15), (helix, 75), (few, 5)):
        law = fitted_law("iterative").for_views(views, turn.grid)
        result = Doubter(rt, scan, scan, None, None, 0).finished(runs)
        np.testing.assert_allclose(result.doubt, spread(*volumes, law), rtol=1e-6)


def test_bars_follow_slopes_density_shape_and_noise() -> None:
    """What both runs do is shape, what they do oppositely is noise; dense matter has wider bars in proportion."""
    volume = np.repeat(np.array([0.0, 1.0, 2.0]), 10)[:, None, None] * np.ones((30, 24, 24))
    bars = spread(*[volume[:20]] * 3, replace(LAW, slope=1.0))
    assert bars[9, 3, 2] == bars[10, 3, 2] == bars.max() and bars[3, 3, 2] < 0.05 * bars.max()
    assert spread(*[volume[:, :, :1]] * 3, LAW).shape == (30, 24, 1)
    one, two = volume + 0.01 * np.random.default_rng(3).standard_normal((2, *volume.shape))
    plain, wide = (spread(volume, one, two, replace(LAW, density=k)) for k in (0.0, 1.0))
    added = np.sqrt(np.mean((wide**2 - plain**2)[:, 4:-4, 4:-4], axis=(1, 2)))
    assert added[25] == pytest.approx(np.sqrt(2) * added[15], rel=1e-3) and added[4] < 1e-6
    one, inner = np.random.default_rng(0).standard_normal((24, 24, 24)), np.s_[4:-4, 4:-4, 4:-4]
    for other, law in ((-one, replace(LAW, shape=0.0, noise=2.0)), (one, replace(LAW, shape=2.0, noise=0.0))):
        assert np.sqrt(np.mean(spread(0 * one, one, other, law)[inner] ** 2)) == pytest.approx(2, rel=0.1)
        assert not spread(0 * one, one, -other, law).any()
    assert np.sqrt(np.mean(spread(0 * one, 3 + one, 3 - one, LAW)[inner] ** 2)) == pytest.approx(10**0.5, rel=0.1)


def test_bars_are_wider_with_few_views_for_the_grid_and_narrower_with_many() -> None:
    """The factor is 1 with 25 views of 64 voxels, the longer side of a slice. Fewer than 0.1 a voxel count as so many."""
    law, grid = replace(LAW, sparse=0.25, dense=0.5, slope=1.0), Grid((9, 32, 64), (1.0,) * 3)
    volume, one, two = np.random.default_rng(1).random((3, 8, 8, 8))
    for views, times in ((25, 1.0), (100, 0.5), (10, 1.375), (1, 0.75 + 0.25 * 25 / 6.4)):
        bars = spread(volume, one, two, law.for_views(views, grid))
        np.testing.assert_allclose(bars, times * spread(volume, one, two, law), rtol=1e-6)


def test_chance_does_not_widen_bars_below_the_noise_but_other_causes_do() -> None:
    rng, noise = np.random.default_rng(2), np.ones(900)
    by_chance = [widening(rng.standard_normal(900), noise, 0.1 * noise) for _ in range(100)]
    assert np.mean(np.array(by_chance) == 1) > 0.9
    for factor in (2.0, 3.0):
        errors = np.hypot(1, factor) * rng.standard_normal(100_000)
        assert widening(errors, np.ones(100_000), np.ones(100_000)) == pytest.approx(factor, rel=0.05)
    assert widening(np.array([5.0]), np.ones(1), np.ones(1)) >= 1


def test_noise_is_told_from_what_is_smooth_where_pixels_are_valid() -> None:
    rows, columns = np.mgrid[:40, :40]
    residual = (0.1 * np.random.default_rng(0).standard_normal((40, 40)) + 0.02 * rows + 0.03 * columns).astype(np.float32)
    residual[:, 20:] *= 0.5
    valid = np.ones((40, 40), bool)
    residual[10, 10], valid[10, 10] = 1e3, False
    noise = noise_map(residual, valid)
    assert noise[:, :12].mean() == pytest.approx(0.1, rel=0.1) and noise[:, 28:].mean() == pytest.approx(0.05, rel=0.1)
    one_row = np.random.default_rng(1).standard_normal((1, 1000)).astype(np.float32)
    assert noise_map(one_row, np.ones((1, 1000), bool)).mean() == pytest.approx(1, rel=0.15)


def test_finer_voxels_keep_the_means_and_come_nearer_to_what_the_voxels_are_means_of(rt) -> None:
    """The projector blurs by a voxel: error bars counted this as an error, up to twice the true one with many views."""
    random = np.random.default_rng(2)
    fine = gaussian_filter(random.random((40, 40, 40)), 2.0).astype(np.float32)
    coarse = block_means(fine, (2, 2, 2))
    again = finer(coarse)
    np.testing.assert_allclose(block_means(again, (2, 2, 2)), coarse, atol=1e-6)
    inner, repeats = np.s_[8:-8, 8:-8, 8:-8], coarse.repeat(2, 0).repeat(2, 1).repeat(2, 2)
    assert np.std((again - fine)[inner]) < 0.2 * np.std((repeats - fine)[inner])
    assert finer(np.ones((1, 3, 2), np.float32)).shape == (2, 6, 4)


def test_a_run_goes_on_with_the_same_bits_from_each_of_its_three_parts(rt, scan, tmp_path) -> None:
    whole = reconstruct(scan, device=rt, doubt=True, holdout=3.0, **FEW)
    for iteration in (2, 6, 11):

        def stop(progress, at=iteration):
            assert progress.iterations == 12
            if progress.iteration == at:
                raise KeyboardInterrupt

        usual = {**FEW, "report": stop, "on_interrupt": "return", "doubt": True, "holdout": 3.0}
        partial = reconstruct(scan, device=rt, **usual)
        assert partial.doubt is None and partial.facts["interrupted_at"] == (iteration - 1) % 4 + 1
        assert partial.facts[DOUBT]["interrupted_in_run"] == (part := {2: "1 of 3", 6: "2 of 3", 11: "3 of 3"}[iteration])
        place = f"iteration {(iteration - 1) % 4 + 1} of 4 of run {part}"
        assert repr(partial).endswith(f"interrupted at {place})") and place in str(interrupted(partial))
        write_checkpoint(tmp_path / "state.h5", partial.state)
        partial = replace(partial, state=read_checkpoint(tmp_path / "state.h5"))
        result = reconstruct(scan, device=rt, doubt=True, holdout=3.0, resume=partial, **FEW)
        np.testing.assert_array_equal(result.volume, whole.volume)
        np.testing.assert_array_equal(result.doubt, whole.doubt)
        assert {**result.facts[DOUBT]} == whole.facts[DOUBT] and result.state is None


@pytest.mark.slow
def test_gaussians_of_the_first_run_are_kept_by_a_state(rt, scan) -> None:
    def report(progress):
        if progress.iteration > progress.iterations // 3:
            raise KeyboardInterrupt

    usual = {"method": "r2", "iterations": 60, "gaussians": 30, "device": rt, "doubt": True}
    partial = reconstruct(scan, report=report, on_interrupt="return", **usual)
    result = reconstruct(scan, report=False, resume=partial, **usual)
    for name in ("mean", "scale", "density"):
        np.testing.assert_array_equal(getattr(result.gaussians, name), getattr(partial.gaussians, name))
    assert result.doubt is not None


@pytest.mark.parametrize(("angles", "is_short"), [(np.linspace(0, 180, 24, False), False), (np.linspace(5, 150, 24), True)])
def test_analytic_bars_on_less_than_half_a_turn_warn(rt, scan, angles, is_short, caplog) -> None:
    frames = np.resize(scan.projections, (24, *scan.projections.shape[1:]))
    part = static_scan(frames, scan.geometry, angles, grid=scan.grid)
    reconstruct(part, "fdk", device=rt, report=False, doubt=True)
    assert ("half a turn without views" in caplog.text) == is_short


def test_held_out_pixels_widen_bars_that_do_not_reach_them(rt, scan, monkeypatch, caplog) -> None:
    right = reconstruct(scan, device=rt, doubt=True, holdout=10.0, **FEW)
    assert "farther off" not in caplog.text
    monkeypatch.setattr(doubt, "fitted_law", lambda kind: Law(0.02, 0.02, 0.0, 0.0, 0.55, 3.0))
    narrow = reconstruct(scan, device=rt, doubt=True, holdout=10.0, **FEW)
    assert "farther off" in caplog.text and "give --holdout" not in caplog.text
    assert 1 <= right.facts[DOUBT]["held_out_factor"] < narrow.facts[DOUBT]["held_out_factor"] <= 4
    assert right.facts[DOUBT]["held_out_within"] > 0.5


def test_a_residual_far_above_the_noise_and_much_noise_are_warned_of(rt, caplog) -> None:
    """Of errors of the scan's description, bars hold what the residual shows: on real scans they were too narrow."""
    usual = {"method": "sirt", "iterations": 60, "report": False, "device": rt, "doubt": True}
    scan, noisy = (simulate("foot", size=16, detector=32, views=12, noise="tigre", dose=d, device=rt) for d in (2e4, 300))
    waves = 1 + 0.3 * np.sin(np.arange(32) / 3 + np.arange(scan.frames)[:, None, None])
    wrong = replace(scan, projections=(scan.projections * waves).astype(np.float32))
    for one, is_unexplained, is_noisy in ((scan, False, False), (wrong, True, False), (noisy, False, True)):
        caplog.clear()
        reconstruct(one, **usual)
        assert ("times the noise of the projections unexplained" in caplog.text) == is_unexplained
        assert ("do not hold soft texture" in caplog.text) == is_noisy


def test_a_box_has_its_part_of_the_bars_and_a_scan_without_a_method_has_none(rt, scan) -> None:
    result = reconstruct(scan, "fdk", preset="hann", device=rt, report=False, doubt=True)
    part = scan.grid.part((2, 3, 4), (6, 5, 4))
    np.testing.assert_array_equal(result.within(part).doubt, result.doubt[2:8, 3:8, 4:8])
    with pytest.raises(InputError, match="doubt"):
        prepare(scan, "sparks", device=rt, doubt=True)


def test_runs_whose_bars_would_not_hold_have_none_or_a_warning(rt, scan, caplog) -> None:
    """All runs share a first volume's errors; a volume that never changes has no difference to learn from. The three runs
    warn of a scan once, and the next command warns again."""
    few = static_scan(scan.projections[:3], scan.geometry, np.array([0.0, 120.0, 240.0]), grid=scan.grid)
    usual = {"device": rt, "doubt": True}
    assert_refused({
        "^doubt: ": lambda: reconstruct(scan, **usual, initial=scan.reference, **FEW),
        "doubt: found frames: 3; expected 4 or more": lambda: reconstruct(few, "fdk", **usual, report=False),
        "doubt: found iterations 0; .* raise iterations": lambda: reconstruct(scan, **usual, **{**FEW, "iterations": 0}),
    })  # fmt: skip
    caplog.clear()
    still = reconstruct(scan, lambda scan, options, rt: scan.reference, device=rt, doubt=True, report=False)
    assert still.doubt is None and "same volume" in caplog.text and "may be far too narrow" in caplog.text
    one_angle = static_scan(scan.projections[:4], scan.geometry, np.zeros(4), grid=scan.grid)
    for count in (1, 2):
        reconstruct(one_angle, "fdk", device=rt, report=False, doubt=True)
        assert caplog.text.count("all views are from one angle") == count
