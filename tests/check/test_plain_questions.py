"""The questions that need no reconstruction: each finds what is planted for it and is silent without."""

from dataclasses import replace

import numpy as np
import pytest
from check_kit import cropped, some_frames

from phyradgs_cl.acquisition import ConeGeometry, Saturation, pixel_centres
from phyradgs_cl.acquisition.altered.angles import exposure_arc_rad
from phyradgs_cl.acquisition.trajectory import CircularOrbit, EncoderTable, FrameSweeps, PoseTable
from phyradgs_cl.api import static_scan
from phyradgs_cl.check import OK, SUSPICIOUS, CountReader
from phyradgs_cl.check.consistency import repeated_frames
from phyradgs_cl.check.coverage import check_coverage, find_noise
from phyradgs_cl.check.detector import check_dead_pixels, check_saturation
from phyradgs_cl.check.timing import check_angles, check_timing
from phyradgs_cl.detector.effects import beer_lambert_noise, tigre_noise
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom


@pytest.mark.parametrize("noisy", [beer_lambert_noise, tigre_noise])
def test_noise_is_named_only_where_it_dominates(clean, noisy) -> None:
    """Not that of 1000 photons, nor noise without an object, which is another finding."""
    rng, frames = np.random.default_rng(3), clean.projections * (2 / clean.projections.max())
    for photons, is_named in ((1e4, False), (1e3, False), (30, True)):
        finding = find_noise(replace(clean, projections=noisy(frames, photons, 10.0, rng)))
        assert (finding is not None) == is_named, (photons, finding)
    assert finding.verdict == SUSPICIOUS and "% of the line integrals" in finding.text
    empty = rng.normal(0, 0.3, clean.projections.shape).astype(np.float32)
    for p in (clean.projections, empty, 0 * empty):
        assert find_noise(replace(clean, projections=p)) is None


def test_frames_must_follow_each_other(clean) -> None:
    """A line cannot open twice, nor two frames be read at once."""
    period_s = float(np.diff(clean.frame_start_s)[0])
    for name in ("exposure_s", "readout_s"):
        finding = check_timing(replace(clean, shutter=replace(clean.shutter, **{name: 2 * period_s})))
        assert finding.verdict == SUSPICIOUS and name.split("_")[0] in finding.text
        assert finding.value == pytest.approx(2.0)
    start_s = clean.frame_start_s.copy()
    start_s[3] = start_s[2]
    assert check_timing(replace(clean, frame_start_s=start_s)).verdict == SUSPICIOUS


def test_views_of_a_round_object_in_golden_order_are_not_repeated_ones() -> None:
    """Some are alike as no neighbours are, but a frame that was recorded twice differs by noise, or not at all."""
    geometry, angles_deg = ConeGeometry(100.0, 150.0, (12, 20), 1.0), 137.50776405 * np.arange(60)
    balls = (Ellipsoid((0.0, 0.0, 0.0), (5.0,) * 3, 0.02), Ellipsoid((1.5, 0.7, 0.4), (1.2,) * 3, 0.01))
    pixels = pixel_centres(poses := geometry.pose(np.deg2rad(angles_deg)), geometry.detector_shape)
    sources = np.broadcast_to(poses[:, None, None, :3], pixels.shape)
    frames = EllipsoidPhantom(balls, "two balls").line_integrals(sources, pixels).astype(np.float32)
    for noise in (0.0, 1e-3):
        seen = frames + np.random.default_rng(5).normal(0, noise, frames.shape).astype(np.float32)
        assert repeated_frames(static_scan(seen, geometry, angles_deg)) == []
        seen[31] = frames[30] + np.random.default_rng(6).normal(0, noise, frames[30].shape)
        assert noise == 1e-3 or repeated_frames(static_scan(seen, geometry, angles_deg)) == [31]  # lost in noise
        hot = np.zeros((12, 20), bool)
        hot[:, :3] = True
        seen[:, hot] = np.where(np.arange(60) == 32, 0, np.linspace(3, 9, 60))[:, None]
        of_masked = replace(static_scan(seen, geometry, angles_deg), pixel_mask=hot)
        assert noise == 1e-3 or repeated_frames(of_masked) == [31]


def test_speed_within_frames_fits_the_steps_between_them_but_for_wandering(clean) -> None:
    sweeps = clean.trajectory.kinematics
    slower = replace(sweeps, angle_end_rad=(sweeps.angle_start_rad + sweeps.angle_end_rad) / 2)
    finding = check_timing(replace(clean, trajectory=CircularOrbit(clean.geometry, slower)))
    assert finding.verdict == SUSPICIOUS and "12° from frame to frame, the angles say 24°" in finding.advice
    time_s = np.linspace(0, 30, 301)
    table = EncoderTable(time_s, np.deg2rad(24 * time_s) + 0.02 * np.sin(time_s))
    scan = replace(clean, trajectory=CircularOrbit(clean.geometry, table))
    assert check_timing(scan).verdict == OK and np.rad2deg(exposure_arc_rad(clean)) == pytest.approx(24.0)
    assert exposure_arc_rad(replace(clean, is_fly=False)) == 0
    ends = replace(sweeps, angle_end_rad=sweeps.angle_start_rad - np.deg2rad(270))
    long = replace(clean, trajectory=CircularOrbit(clean.geometry, ends))
    assert np.rad2deg(exposure_arc_rad(long)) == pytest.approx(270.0)


def test_a_table_in_another_unit_of_time_than_the_frames(clean) -> None:
    """Long tables are as good where the frames see their turn, and so are short turns of tables as long as the frames."""
    last_s = float(clean.frame_start_s[-1]) + clean.shutter.span_s
    time_s = np.linspace(0, 1.1 * last_s, 40)
    angle_rad = np.deg2rad(24 * time_s)
    log_s, log_rad = np.append(time_s, 500 * last_s), np.append(angle_rad, angle_rad[-1])
    for table, asks in (
        (EncoderTable(1000 * time_s, angle_rad), "in ms"),
        (PoseTable(1000 * time_s, clean.geometry.pose(angle_rad)), "in ms"),
        (EncoderTable(1e6 * time_s, angle_rad), "units"),
        (PoseTable(time_s, clean.geometry.pose(angle_rad)), None),
        (EncoderTable(log_s, log_rad), None),
        (EncoderTable(time_s, angle_rad / 100), None),
    ):
        is_poses = isinstance(table, PoseTable)
        finding = check_timing(replace(clean, trajectory=table if is_poses else CircularOrbit(clean.geometry, table)))
        assert finding.verdict == (SUSPICIOUS if asks else OK), finding
        if asks:
            assert finding.value > 900 and asks in finding.advice, finding
            assert f"the table of {'poses' if is_poses else 'angles'} runs" in finding.text


@pytest.mark.parametrize(("views", "turns", "jitter_deg"), [(25, 2, 0.05), (25, 3, 0.05), (180, 3, 0.01)])
def test_turns_whose_angles_jitter_have_no_gaps(views, turns, jitter_deg) -> None:
    angles = np.tile(np.arange(views) * 360 / views, turns)
    angles = angles + np.random.default_rng(0).normal(0, jitter_deg, len(angles))
    scan = static_scan(np.ones((len(angles), 4, 6)), ConeGeometry(100.0, 150.0, (4, 6), 1.0), angles)
    assert check_angles(scan).verdict == OK


def test_missing_views_and_too_short_a_turn(clean) -> None:
    gap = check_angles(some_frames(clean, np.r_[0:5, 9:15]))
    assert gap.verdict == OK and gap.value == pytest.approx(24)  # a short scan, which is long enough
    two_gaps = check_angles(some_frames(clean, np.r_[0:4, 7:9, 12:15]))
    assert two_gaps.verdict == SUSPICIOUS and two_gaps.value == pytest.approx(96)
    short = check_angles(some_frames(clean, np.arange(6)))
    assert short.verdict == SUSPICIOUS and short.value == pytest.approx(144)  # with half a step before and behind
    alike = check_angles(some_frames(clean, np.zeros(6, int)))
    assert alike.verdict == SUSPICIOUS and alike.text == "1 different angle"


@pytest.mark.parametrize(("away", "verdict"), [(100.0, OK), (1.0, SUSPICIOUS)])
def test_half_a_turn_is_enough_for_rays_that_are_nearly_parallel(clean, away, verdict) -> None:
    """Views at 0, 1, ... 179 degrees, as synchrotrons take them; a fan needs more."""
    geometry = replace(clean.geometry, source_to_axis_mm=5 * away, source_to_detector_mm=7 * away)
    count = np.arange(180)
    angle_rad = np.deg2rad(count)
    orbit = CircularOrbit(geometry, FrameSweeps(1.0 * count, 0.0, angle_rad, angle_rad))
    frames = np.repeat(clean.projections[:1], 180, 0)
    scan = replace(clean, projections=frames, geometry=geometry, trajectory=orbit, frame_start_s=1.0 * count, is_fly=False)
    assert check_angles(scan).verdict == verdict


def test_a_panel_that_cuts_the_object(clean) -> None:
    """A displaced one may, on its short side, if there are opposite views."""
    finding = check_coverage(cropped(clean, np.s_[:, :, 9:23]))
    assert finding.verdict == SUSPICIOUS and finding.value > finding.threshold
    for offset_mm, verdict in ((0.875, OK), (-0.875, SUSPICIOUS)):
        right_half = cropped(clean, np.s_[:, :, 14:32], detector_offset_mm=(0.0, offset_mm))
        assert check_coverage(right_half).verdict == verdict
        assert check_coverage(some_frames(right_half, np.arange(10))).verdict == SUSPICIOUS


def test_saturated_areas_but_not_noise_that_is_cut_off(clean) -> None:
    p = clean.projections
    noise = np.random.default_rng(0).normal(0.1, 0.01, p.shape)
    noisy = np.maximum(noise, 0.1).astype(np.float32)  # every second pixel at the end
    assert check_saturation(replace(clean, projections=noisy)).verdict == OK
    for values, said in (
        (np.maximum(p, 0.1), "least"), (np.minimum(p, np.percentile(p, 90)), "largest"), (np.ones_like(p), "100 % of"),
    ):
        finding = check_saturation(replace(clean, projections=values.astype(np.float32)))
        assert finding.verdict == SUSPICIOUS and said in finding.text


def test_counts_at_the_ceiling_are_seen_on_reading_or_believed_of_an_import(clean) -> None:
    p = clean.projections
    bright, flat = np.minimum(7e4 * np.exp(-p), 65535), np.full((1, *p.shape[1:]), 65535.0)
    data, key = np.concatenate([flat, bright]).astype(np.uint16), np.r_[1, np.zeros(len(p), int)]
    counts = CountReader()
    counts(data, key, "counts")
    assert counts.ceiling == 65535 and counts.at_ceiling > 0.01
    assert check_saturation(clean, counts).verdict == SUSPICIOUS
    invalid = np.full_like(data[:1], 65535)
    counts(np.concatenate([np.minimum(data, 60_000), invalid]), np.r_[key, 3], "counts")
    assert counts.ceiling == 60_000 and counts.at_ceiling > 0.01
    counts, noise = CountReader(), np.random.default_rng(0).poisson(data * 0.1)
    counts(noise.astype(np.uint16), key, "counts")
    assert check_saturation(clean, counts).verdict == OK
    finding = check_saturation(replace(clean, saturation=Saturation(40_000.0, 0.25)))
    assert finding.verdict == SUSPICIOUS and "25 % of the pixels lie together at 40000 counts" in finding.text
    assert check_saturation(replace(clean, saturation=Saturation(40_000.0, 0.0))).verdict == OK


@pytest.mark.parametrize("value", [0.0, 9.9])
def test_dead_pixels_are_found_where_they_are(clean, value) -> None:
    p = clean.projections.copy()
    rows, columns = np.array([3, 10, 20, 29]), np.array([15, 8, 17, 30])
    p[:, rows, columns] = value
    finding, dead = check_dead_pixels(replace(clean, projections=p))
    planted = np.zeros(dead.shape, bool)
    planted[rows, columns] = True
    assert finding.verdict == SUSPICIOUS and np.array_equal(dead, planted)
    masked, _ = check_dead_pixels(replace(clean, projections=p, pixel_mask=planted))
    assert masked.verdict == OK
    # a pixel of the wrong gain is as bad
    p = clean.projections.copy()
    p[:, 12, 13] += 0.5
    finding, dead = check_dead_pixels(replace(clean, projections=p))
    assert finding.verdict == SUSPICIOUS and list(zip(*np.nonzero(dead), strict=True)) == [(12, 13)]


def test_air_without_noise_is_not_dead(clean) -> None:
    """What the object never covers is still, also in the corners of its silhouette; a dead pixel inside is found."""
    moving = np.zeros(clean.geometry.detector_shape, bool)
    moving[4:28, 6:12] = moving[4:12, 6:26] = moving[20:28, 6:26] = True  # still air between two arms
    noise = np.random.default_rng(0).uniform(0.5, 1.0, clean.projections.shape)
    p = np.where(moving, noise, 0).astype(np.float32)
    finding, dead = check_dead_pixels(replace(clean, projections=p))
    assert finding.verdict == OK and not dead.any()
    p[:, 8, 9], p[:, 5, 28] = 0.0, 0.7  # one behind the object, one that is stuck beside it
    finding, dead = check_dead_pixels(replace(clean, projections=p))
    assert finding.verdict == SUSPICIOUS and list(zip(*np.nonzero(dead), strict=True)) == [(5, 28), (8, 9)]


def test_frames_that_are_no_line_integrals_of_an_object(clean) -> None:
    p = clean.projections
    bright = p.copy()
    bright[:, 8:24, 10:22] = -p.max()
    for values, said, advised in (
        (0 * p, "no object", "line integrals"), (-p, "no object", "line integrals"),
        (1000 * np.exp(-p), "largest, 1e+03, beside the object", "--quantity"),
        (50 * p / p.max(), "one photon in", "--quantity"), (bright, "brighter than the flats", "flats from this scan"),
    ):
        finding = check_coverage(replace(clean, projections=values.astype(np.float32)))
        assert finding.verdict == SUSPICIOUS and said in finding.text and advised in finding.advice
    dark = np.zeros(p.shape[1:], bool)
    dark[:, [0, -1]] = True  # behind a collimator
    finding = check_coverage(replace(clean, projections=np.where(dark, np.float32(13.8), p), pixel_mask=dark))
    assert finding.verdict == check_coverage(clean).verdict


def test_a_small_part_on_the_axis_is_not_a_dead_pixel(clean) -> None:
    """It stays in its place on the panel, as a dead pixel does, but is as wide as the panel resolves."""
    row, column = np.indices(clean.geometry.detector_shape)
    verdicts = []
    for u in (15, 8):  # the axis is at 15.5
        part = 0.5 * np.exp(-((row - 20) ** 2 + (column - u) ** 2) / (2 * 0.6**2))
        verdicts.append(check_dead_pixels(replace(clean, projections=clean.projections + part))[0].verdict)
    assert verdicts == [OK, SUSPICIOUS]
    p = clean.projections.copy()
    p[:, [20, 21], 15] = 0.0  # two of them, side by side
    assert check_dead_pixels(replace(clean, projections=p))[1].sum() == 2
