"""Scans from arrays: the same as those of files and of the simulator."""

import re

import numpy as np
import pytest

from phyradgs_cl import api
from phyradgs_cl.api import ConeGeometry, ParallelGeometry, fly_scan, reconstruct, simulate, static_scan
from phyradgs_cl.errors import InputError

pytestmark = pytest.mark.slow
LIGHT, DARK = 40_000.0, 200.0
CONE = ConeGeometry(5.0, 7.0, (6, 8), (0.2, 0.2))


def poses(scan) -> np.ndarray:
    """(F, 4, 12): where the gantry is in each frame."""
    spans = np.linspace(0, scan.shutter.span_s, 4)
    return np.stack([scan.trajectory.pose(f, t + spans) for f, t in enumerate(scan.frame_start_s)])


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_a_fly_scan_from_arrays_is_the_simulated_one(rt, axis, direction) -> None:
    options = {"views": 6, "exposure_deg": 30.0, "readout_axis": axis, "readout_direction": direction}
    made = simulate("jaw", size=8, detector=12, **options, device=rt)
    angles = made.provenance.get("start_deg", 0.0) + 60.0 * np.arange(6)
    how = {"exposure_deg": 30.0, "readout_ratio": 0.86, "readout": axis, "readout_direction": direction}
    scan = fly_scan(made.projections, made.geometry, angles % 360, **how, grid=made.grid)
    assert scan.shutter == made.shutter and scan.is_fly and scan.grid == made.grid
    np.testing.assert_allclose(scan.frame_start_s, made.frame_start_s, atol=1e-12)
    np.testing.assert_allclose(poses(scan), poses(made), atol=1e-12)
    np.testing.assert_array_equal(scan.projections, made.projections)


def test_scans_of_a_parallel_beam_from_arrays_are_the_simulated_ones(rt) -> None:
    angles, how = 60.0 * np.arange(6), {"scanner": "parallel", "views": 6, "exposure_deg": 30.0, "device": rt}
    made, still = (simulate("jaw", size=8, detector=12, protocol=protocol, **how) for protocol in ("rapid", "static"))
    assert made.geometry == ParallelGeometry((12, 12), 2.56 / 12)
    scan = fly_scan(made.projections, made.geometry, angles, exposure_deg=30.0, readout_ratio=0.86, grid=made.grid)
    np.testing.assert_allclose(poses(scan), poses(made), atol=1e-12)
    assert scan.is_parallel and scan.is_fly and scan.grid == made.grid and "parallel beam" in scan.summary()
    scan = static_scan(still.projections, still.geometry, 30.0 * 1.86 / 2 + angles, grid=still.grid)
    np.testing.assert_allclose(poses(scan)[:, 0], poses(still)[:, 0], atol=1e-12)
    assert scan.is_parallel and not scan.is_fly
    scan = fly_scan(made.projections, made.geometry, range(0, 60, 10), exposure_deg=10.0)
    assert scan.grid.size_mm[1] == pytest.approx(2.56)  # the panel's width


def test_a_gantry_that_turns_clockwise_has_a_negative_exposure() -> None:
    scan = fly_scan(np.zeros((5, 6, 8)), CONE, -10.0 * np.arange(5), exposure_deg=-10.0)
    assert np.allclose(np.diff(scan.frame_start_s), 1.0)
    first, last = (scan.trajectory.angle_rad(2, scan.frame_start_s[2] + t) for t in (0.0, 1.0))
    assert np.rad2deg(first) == pytest.approx(-20.0) and np.rad2deg(last) == pytest.approx(-30.0)
    shuffled = fly_scan(np.zeros((5, 6, 8)), CONE, [0, 200, 40, 240, 80], exposure_deg=5.0, readout_ratio=0.5)
    assert np.all(np.diff(shuffled.frame_start_s) > 0)


@pytest.mark.parametrize("kind", [np.uint8, np.int8, np.float16])
def test_small_numbers_of_numpy_neither_overflow_nor_lose_digits(kind) -> None:
    cone, frames, angles = ConeGeometry(5.0, 7.0, (6, 8), (0.2, 0.2)), np.zeros((12, 6, 8), np.float32), 30.0 * np.arange(12)
    scan, exact = (
        fly_scan(frames, cone, angles, exposure_deg=of(12), readout_ratio=of(2), exposure_s=of(100)) for of in (kind, float)
    )
    assert scan.shutter == exact.shutter and scan.shutter.span_s == 300
    np.testing.assert_array_equal(poses(scan), poses(exact))


def test_what_looks_like_radians_transmissions_or_percent_is_said(caplog) -> None:
    cone, frames, turn_deg = CONE, np.zeros((20, 6, 8), np.float32), 18.0 * np.arange(20)
    transmission = np.ones_like(frames)
    transmission[..., 2:6] = 0.3
    cases = [
        (lambda: fly_scan(frames, cone, turn_deg, exposure_deg=18.0), ""),
        (lambda: fly_scan(frames, cone, np.deg2rad(turn_deg), exposure_deg=18.0), "20 frames within 5.969°: .* radians"),
        (lambda: fly_scan(frames, cone, turn_deg, exposure_deg=np.deg2rad(18.0)), "exposure_deg: 1/57.3 .* radians"),
        (lambda: static_scan(frames[:9], cone, np.deg2rad(turn_deg[:9])), ""),
        (lambda: fly_scan(frames, cone, turn_deg, exposure_deg=9.0, readout_ratio=2.0), ""),
        (lambda: fly_scan(frames, cone, turn_deg, exposure_deg=9.0, readout_ratio=86), "_ratio: .* 43 times"),
        (lambda: static_scan(transmission, cone, turn_deg), "frames: 1 at their borders.* Say quantity trans"),
        (lambda: static_scan(transmission, cone, turn_deg, quantity="transmission"), ""),
        (lambda: static_scan(2 - transmission, cone, turn_deg), ""),  # an object wider than the panel
    ]
    with pytest.raises(InputError, match="^quantity: found line integrals down to -4.61, 100 % of pixels"):
        static_scan(100 * transmission, cone, turn_deg, quantity="transmission")
    for number, (make, words) in enumerate(cases):
        caplog.clear()
        make()
        assert len(caplog.messages) == bool(words) and re.search(words, "".join(caplog.messages)), number


def test_numpy_numbers_are_numbers(rt, tmp_path) -> None:
    whole, half = np.int64, np.float32(0.5)
    scan = simulate("jaw", size=whole(8), detector=whole(12), views=whole(6), exposure_deg=np.float32(30), device=rt)
    how = {"motion": "micro-views", "strips": whole(2), "sub_intervals": np.uint8(2), "seed": whole(3), "device": rt}
    results = [
        reconstruct(scan, "sirt", iterations=whole(2), relaxation=half, size=whole(6), **how),
        reconstruct(scan, "sirt", iterations=2, motion=api.PerRow(whole(2)), roi_mm=0.5 * scan.grid.box_mm, device=rt),
        reconstruct(scan, "phyradgs", iterations=whole(2), gaussians=whole(50), control={"every": whole(5)}, device=rt),
    ]
    for result in results:
        api.save_volume(tmp_path / "v.h5", result)
        assert api.load_volume(tmp_path / "v.h5").facts["options"]["iterations"] == 2
    assert results[0].grid.shape == (6, 6, 6) and api.initial_gaussians(scan, whole(20), device=rt).count <= 20
    cone = ConeGeometry(np.float32(5), whole(7), np.array([6, 8]), (half, half))
    frames = np.zeros((4, 6, 8), np.float32)
    fly = fly_scan(frames, cone, range(0, 40, 10), exposure_deg=whole(10), readout_ratio=half, readout_direction=whole(1))
    fly.plot(whole(1))
    api.save_scan(tmp_path / "s.h5", fly)
    assert api.Grid.cube(whole(4), np.float32(2)).shape == (4, 4, 4) and api.load_scan(tmp_path / "s.h5").frames == 4


def test_counts_are_divided_and_bad_pixels_masked(tmp_path) -> None:
    cone, wanted = CONE, np.random.default_rng(0).uniform(0, 2, (4, 6, 8))
    counts = DARK + LIGHT * np.exp(-wanted)
    flats, darks = np.full((3, 6, 8), DARK + LIGHT), np.full((2, 6, 8), DARK)
    counts[:, 1, 2] = DARK - 5  # a dead pixel
    mask = np.zeros((6, 8))
    mask[4, 5] = 1
    scan = static_scan(counts, cone, 90.0 * np.arange(4), flats=flats, darks=darks, mask=mask, title="mine")
    bad = scan.pixel_mask != 0
    assert sorted(zip(*np.nonzero(bad), strict=True)) == [(1, 2), (4, 5)]
    np.testing.assert_allclose(scan.projections[:, ~bad], wanted[:, ~bad], atol=1e-5)
    single = static_scan(counts, cone, 90.0 * np.arange(4), flats=flats[0], darks=darks[0], mask=mask)
    np.testing.assert_array_equal(single.projections, scan.projections)
    assert "stop-and-shoot" in repr(scan) and not scan.is_fly and scan.saturation is not None
    applied = {"flats_applied": 3, "darks_applied": 2}
    assert scan.provenance == {**applied, "taken": "flats: the median of 3; darks: the median of 2"}
    api.save_scan(tmp_path / "s.h5", scan)
    np.testing.assert_array_equal((again := api.load_scan(tmp_path / "s.h5")).pixel_mask != 0, bad)
    np.testing.assert_allclose(poses(again), poses(scan), atol=1e-9)
    of_transmission = static_scan(np.exp(-wanted), cone, 90.0 * np.arange(4), quantity="transmission")
    np.testing.assert_allclose(of_transmission.projections, wanted, atol=1e-5)
