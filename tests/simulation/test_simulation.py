"""The simulator: each line over its own window, sampled finely enough, with scaling, noise and refusals."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from kernel_kit import assert_near
from tolerances import ANALYTIC_FRAME, FLOAT32, TIME_SAMPLING, VOXEL_SOURCE

from phyradgs_cl import api, simulation
from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Protocol, make_protocol, pixel_centres
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import EllipsoidPhantom, shepp_logan
from phyradgs_cl.simulation import AnalyticSource, SimulationOptions, VolumeSource, phantom_scene, simulate
from phyradgs_cl.simulation.scenes import bone_from

SHAPE = (14, 18)
GEOMETRY = ConeGeometry(5.0, 7.5, SHAPE, (3.9 / 14, 3.9 / 18))
PARALLEL = ParallelGeometry(SHAPE, (2.8 / 14, 2.8 / 18), (0.05, -0.04))
GRID = Grid.cube(16, 2.0)
PHANTOM = shepp_logan(1.0)
FLY = Protocol(views=3, exposure_deg=12.0, readout_ratio=0.5)


def run(options: SimulationOptions, phantom: EllipsoidPhantom = PHANTOM, **more: object):
    return simulate(AnalyticSource(phantom, GEOMETRY), GEOMETRY, GRID, options, **more)


@pytest.mark.parametrize(("axis", "direction"), [("rows", 1), ("columns", -1)])
@pytest.mark.parametrize("model", ["log", "intensity"])
def test_every_line_averages_over_its_own_window_and_every_pixel_over_its_area(rt, axis, direction, model) -> None:
    """Rays and angles written out: line r opens r/(H−1) of the readout late, and sees 12° from there on."""
    options = SimulationOptions(FLY, axis, direction, model, time_samples=4, peak=6.0)
    lines, frames = SHAPE[axis == "columns"], {}
    for n in (1, 3):
        scene = phantom_scene(rt, "shepp-logan", GEOMETRY, GRID, 16, axis, 0, pixel_samples=n)
        scan, expected = simulate(scene.source, GEOMETRY, GRID, options), np.zeros(SHAPE)
        for line in range(lines):
            where = (line, slice(None)) if axis == "rows" else (slice(None), line)
            delay_deg, rays = (line if direction > 0 else lines - 1 - line) / (lines - 1) * 0.5 * 12.0, []
            for pose in GEOMETRY.pose(np.deg2rad(120.0 + delay_deg + (np.arange(4) + 0.5) / 4 * 12.0)):
                shifts = [dy * pose[9:12] + dx * pose[6:9] for dy, dx in product((np.arange(n) - n // 2) / n, repeat=2)]
                pixels = pixel_centres(pose, SHAPE)[where] + np.array(shifts)[:, None]
                rays.extend(scan.provenance["attenuation_factor"] * PHANTOM.line_integrals(pose[:3], pixels))
            light = np.exp(-np.array(rays)).mean(axis=0)
            expected[where] = np.mean(rays, axis=0) if model == "log" else -np.log(light)
        frames[n] = scan.projections[1]
        assert_near(frames[n], expected, ANALYTIC_FRAME)
    assert np.abs(frames[1] - frames[3]).max() > 0.1


@pytest.mark.parametrize("protocol", ["rapid", "standard"])
@pytest.mark.parametrize("source", ["analytic", "voxels"])
def test_default_time_samples_are_enough(rt, protocol, source) -> None:
    """Four times the samples change a frame by less than the stated share (relative L2)."""
    fly = replace(make_protocol(protocol), views=2)
    voxels = VolumeSource(rt, PHANTOM.voxelise(GRID), GRID, GEOMETRY, "rows")
    frames = AnalyticSource(PHANTOM, GEOMETRY) if source == "analytic" else voxels
    counts = simulation.default_time_samples(fly, GRID) * np.array([1, 4])
    scans = (simulate(frames, GEOMETRY, GRID, SimulationOptions(fly, time_samples=int(n))) for n in counts)
    coarse, fine = (scan.projections for scan in scans)
    assert 0 < np.linalg.norm(coarse - fine) / np.linalg.norm(fine) <= TIME_SAMPLING


def test_default_time_samples_follow_arc_and_voxels() -> None:
    fine, samples = Grid.cube(256, 2.0), simulation.default_time_samples
    rapid, standard = (samples(make_protocol(name), fine) for name in ("rapid", "standard"))
    arc_voxels = np.deg2rad(14.4) * 128
    assert rapid == int(np.ceil(2 * arc_voxels)) and standard == int(np.ceil(arc_voxels))
    assert samples(make_protocol("rapid"), GRID) == 8 and samples(Protocol(exposure_deg=300.0), fine) == 128
    assert run(SimulationOptions(FLY)).provenance["time_samples"] == 8


@pytest.mark.parametrize("geometry", [GEOMETRY, PARALLEL], ids=["cone", "parallel"])
def test_voxels_and_closed_form_meet(rt, geometry) -> None:
    grid = Grid.cube(64, 2.0)
    source = VolumeSource(rt, PHANTOM.voxelise(grid, 3), grid, geometry, "columns")
    options = SimulationOptions(FLY, "columns", time_samples=4)
    voxels = simulate(source, geometry, grid, options).projections
    exact = simulate(AnalyticSource(PHANTOM, geometry), geometry, grid, options).projections
    assert np.linalg.norm(voxels - exact) <= VOXEL_SOURCE * np.linalg.norm(exact)


def test_no_material_is_half_bone() -> None:
    """Half the largest attenuation, but above what it would divide; an object of one material is all bone."""
    volume = np.random.default_rng(2).normal(0.3, 0.02, (20, 20, 20))
    volume[:5], volume[5:8] = 0.0, 1.0
    assert bone_from(volume) == 0.5 and bone_from(np.full((4, 4, 4), 0.2)) == 0.1
    volume[10:] += 0.22
    assert np.mean(volume[10:] >= bone_from(volume)) < 0.1


def test_peak_scales_frames_and_reference_alike() -> None:
    reference = PHANTOM.voxelise(GRID)
    plain, peaked = (run(SimulationOptions(FLY, peak=p), reference=reference) for p in (0.0, 4.0))
    factor = peaked.provenance["attenuation_factor"]
    assert peaked.projections.max() == pytest.approx(4.0, rel=FLOAT32) and factor > 1
    np.testing.assert_allclose(peaked.projections, plain.projections * factor, rtol=FLOAT32)
    np.testing.assert_allclose(peaked.reference, reference * factor, rtol=FLOAT32)
    np.testing.assert_array_equal(plain.reference, reference)
    with pytest.raises(InputError, match="--peak"):
        run(SimulationOptions(FLY, peak=4.0), EllipsoidPhantom((), "nothing"))


def test_a_pulse_freezes_what_it_lights() -> None:
    """A short flash in every line's window is one pose; lines that it misses hold nothing and are masked."""
    flash = replace(FLY, readout_ratio=1.5, pulse=(0.8, 1e-6))
    scan = run(SimulationOptions(flash))
    assert scan.shutter.pulse_s == (0.8, 1e-6)
    np.testing.assert_allclose(scan.middle_times_s, scan.frame_start_s + 0.8, atol=1e-6)
    lit = np.flatnonzero(np.arange(SHAPE[0]) / (SHAPE[0] - 1) * 1.5 < 0.8)
    pose = GEOMETRY.pose(np.deg2rad(120.0 + 0.8 * 12.0))
    expected = PHANTOM.line_integrals(pose[:3], pixel_centres(pose, SHAPE))
    np.testing.assert_allclose(scan.projections[1][lit], expected[lit], rtol=0, atol=1e-4)
    dark = np.setdiff1d(np.arange(SHAPE[0]), lit)
    assert not scan.projections[:, dark].any() and scan.pixel_mask[dark].all() and not scan.pixel_mask[lit].any()


@pytest.mark.parametrize("noise", ["tigre", "beer"])
def test_lines_that_see_less_of_a_pulse_are_noisier(noise) -> None:
    pulsed = replace(FLY, pulse=(-0.5, 0.6))  # light ends 0.1 after the start: line r sees 0.1 − r/13·0.5
    clean, noisy = (run(SimulationOptions(pulsed, noise=n, electronic_noise=0.0)) for n in ("none", noise))
    share = clean.shutter.lit_share(SHAPE[0])
    dark = share == 0
    assert dark.sum() == 11 and not noisy.projections[:, dark].any()
    first, last = (np.std((noisy.projections - clean.projections)[:, line]) for line in (0, 2))
    assert last > 1.3 * first


@pytest.mark.parametrize("noise", ["none", "tigre", "beer"])
def test_lag_leaves_a_ghost_of_the_frame_before(noise) -> None:
    options = SimulationOptions(FLY, peak=3.0, lag=0.2, noise=noise, dose=1e9, electronic_noise=0.0)
    slow, clean = run(options), run(replace(options, lag=0.0, noise="none"))
    signal = np.exp(-clean.projections.astype(np.float64))
    expected = [0.8 * signal[0], 0.8 * signal[1] + 0.16 * signal[0]]
    tolerance = 1e-3 if noise != "none" else 1e-6
    np.testing.assert_allclose(slow.projections[:2], -np.log(expected), atol=tolerance)
    assert slow.lag == 0.2


@pytest.mark.parametrize("noise", ["tigre", "beer"])
def test_noise_has_a_seed_and_a_dose(noise) -> None:
    clean, noisy = run(SimulationOptions(FLY)).projections, SimulationOptions(FLY, noise=noise, dose=1e4)
    one, same, other = (run(replace(noisy, seed=seed)).projections for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.any(one != other)
    faint = run(SimulationOptions(FLY, noise=noise, dose=1e2, electronic_noise=0.0, seed=1)).projections
    assert 0 < np.std(one - clean) < np.std(faint - clean) / 3


def test_jitter_moves_the_true_gantry_and_is_recorded() -> None:
    steady, shaken = (run(SimulationOptions(FLY, jitter_deg=j, seed=3)) for j in (0.0, 2.0))
    assert np.abs(steady.projections - shaken.projections).max() > 1e-3
    time_s = steady.frame_start_s[1] + np.linspace(0, steady.shutter.span_s, 5)
    wander = shaken.trajectory.angle_rad(1, time_s) - steady.trajectory.angle_rad(1, time_s)
    assert 0 < np.abs(wander).max() < np.deg2rad(10)
    shaken.check_timing()  # the encoder covers every frame's window


def test_a_box_that_a_procedural_phantom_does_not_fill_is_said(rt, caplog) -> None:
    geometry = ConeGeometry(5.0, 7.0, (8, 8), (0.5, 0.5))
    cube = phantom_scene(rt, "jaw", geometry, Grid.cube(8, 2.0), 8, "rows", 0)
    assert not caplog.records
    flat = Grid((4, 8, 8), (0.25, 0.25, 0.25), (0.1, 0.0, 0.0))
    scene = phantom_scene(rt, "jaw", geometry, flat, 8, "rows", 0)
    assert "not used" in caplog.text and scene.grid == Grid.cube(8, 1.0) and cube.grid == Grid.cube(8, 2.0)


@pytest.mark.parametrize(("words", "overlaps"), [
    ({"views": 30}, True), ({"views": 25}, False), ({"views": 30, "protocol": "static"}, False),
    ({"views": 30, "turns": -2.0}, False), ({"views": 30, "exposure_deg": 12.0}, False), ({"views": 1}, False),
])  # fmt: skip
def test_exposures_of_two_frames_at_the_same_time_are_warned_of(rt, caplog, words, overlaps) -> None:
    api.simulate("shepp-logan", size=4, detector=4, time_samples=1, **words, device=rt)
    assert ("no panel exposes two frames at the same time" in caplog.text) == overlaps


def test_wide_pixels_average_by_themselves(rt) -> None:
    """Rays through the middles of pixels alone would miss the voxels between them."""
    panel = ParallelGeometry((6, 6), 2.0)
    for voxels, samples in ((6, 1), (9, 1), (10, 2), (18, 3), (30, 5)):
        scene = phantom_scene(rt, "shepp-logan", panel, Grid.cube(6, 12.0), voxels, "rows", 0)
        assert scene.source.pixel_samples == samples
    magnified = replace(GEOMETRY, pixel_size_mm=(2.0 * GEOMETRY.magnification,) * 2)
    assert phantom_scene(rt, "shepp-logan", magnified, Grid.cube(6, 12.0), 18, "rows", 0).source.pixel_samples == 3
