"""Coarse scans and hypotheses: the same poses and times, by another route."""

from dataclasses import replace

import numpy as np
import pytest
from check_kit import cropped, negative, stated

from phyradgs_cl.acquisition import CircularOrbit, PoseTable, Shutter, pixel_centres
from phyradgs_cl.acquisition.altered.coarse import binned, smooth
from phyradgs_cl.acquisition.altered.variants import reversed_readout, reversed_rotation, shifted
from phyradgs_cl.reconstructors.fits.residuals import residual_ratio, t_statistic, vertex

CLOSE = {"rtol": 0, "atol": 1e-12}


def poses(scan):
    asked = enumerate(scan.frame_start_s)
    return np.stack([scan.trajectory.pose(frame, np.array([s, s + 0.7])) for frame, s in asked])


def displaced(scan, u_mm):
    return stated(scan, detector_offset_mm=(0.3, u_mm))


def test_what_hypotheses_change_and_where_a_panel_of_blocks_stands(clean) -> None:
    """The panel of blocks as stated is where its orbit has it."""
    scan = displaced(clean, 0.4)
    np.testing.assert_allclose(poses(reversed_rotation(scan)), poses(negative(scan)), **CLOSE)
    moved = displaced(clean, 0.4 + 2.5 * clean.geometry.pixel_size_mm[1])
    np.testing.assert_allclose(poses(shifted(displaced(clean, 0.4), 2.5)), poses(moved), **CLOSE)
    assert reversed_readout(clean).shutter.direction == -1
    small = binned(scan, 3)
    orbit = CircularOrbit(small.geometry, clean.trajectory.kinematics)
    np.testing.assert_allclose(poses(small), poses(replace(small, trajectory=orbit)), **CLOSE)
    time_s = np.linspace(-1, 30, 400)
    table = replace(clean, trajectory=PoseTable(time_s, clean.geometry.pose(np.deg2rad(24 * time_s))))
    for changed in (reversed_rotation, lambda one: shifted(one, 2.0)):
        np.testing.assert_allclose(poses(changed(table)), poses(changed(clean)), atol=1e-6)


@pytest.mark.parametrize(("rows", "block", "high"), [(32, 2, 2), (32, 3, 3), (2, 3, 2), (1, 4, 1)])
def test_blocks_stand_in_the_middle_of_their_pixels(clean, rows, block, high) -> None:
    """A panel of few rows is one block high."""
    part = cropped(clean, np.s_[:, 16 - rows // 2 : 16 + (rows + 1) // 2])
    scan = shifted(reversed_rotation(displaced(part, 0.4)), 1.5)
    small = binned(scan, block)
    rows, columns = small.geometry.detector_shape
    assert (rows, columns) == (scan.geometry.detector_shape[0] // high, 32 // block)
    fine = pixel_centres(poses(scan), scan.geometry.detector_shape)[:, :, : rows * high, : columns * block]
    middle = fine.reshape(*fine.shape[:2], rows, high, columns, block, 3).mean((3, 5))
    asked = zip(small.frame_start_s, small.frame_start_s - scan.frame_start_s, strict=True)
    again = np.stack([small.trajectory.pose(f, np.array([s, s + 0.7]) - later) for f, (s, later) in enumerate(asked)])
    np.testing.assert_allclose(pixel_centres(again, small.geometry.detector_shape), middle, **CLOSE)


@pytest.mark.parametrize(("direction", "block"), [(1, 2), (-1, 3)])
def test_blocks_of_lines_open_when_their_lines_do_on_average(clean, direction, block) -> None:
    scan = replace(clean, shutter=Shutter(1.0, 0.5, "rows", direction, None))
    small, count = binned(scan, block), 32 // block
    lines = scan.shutter.line_windows_s(32)[: count * block].reshape(count, block, 2).mean(1)
    later_s = float(small.frame_start_s[0] - scan.frame_start_s[0])
    np.testing.assert_allclose(later_s + small.shutter.line_windows_s(count), lines, **CLOSE)
    pulsed = binned(replace(scan, shutter=replace(scan.shutter, pulse_s=(0.3, 0.8))), block).shutter.pulse_s
    assert small.shutter.pulse_s is None and pulsed == pytest.approx((0.3 - later_s, 0.8))


def test_masked_pixels_are_left_out_of_their_block(clean) -> None:
    p, mask = clean.projections.copy(), np.zeros((32, 32), bool)
    mask[4, 6], mask[8:10, 8:10] = True, True
    p[:, mask] = 99.0
    small = binned(replace(clean, projections=p, pixel_mask=mask), 2)
    expected = (p[:, 4, 7] + p[:, 5, 6] + p[:, 5, 7]) / 3
    np.testing.assert_allclose(small.projections[:, 2, 3], expected, rtol=1e-6)
    assert np.argwhere(small.pixel_mask[0]).tolist() == [[4, 4]]


def test_blocks_of_smoothed_pixels_are_those_of_smoothed_frames_and_take_nothing_of_masked_ones(clean) -> None:
    np.testing.assert_allclose(binned(clean, 5, 4.0).projections, binned(smooth(clean, 4.0), 5).projections, atol=1e-6)
    mask = np.random.default_rng(0).random(clean.projections.shape) < 0.05
    ramp = np.broadcast_to(np.arange(32, dtype=np.float32), mask.shape)
    masked = replace(clean, projections=np.where(mask, np.float32(1e4), ramp), pixel_mask=mask)
    means = binned(replace(clean, projections=ramp), 5, 4.0).projections
    np.testing.assert_allclose(binned(masked, 5, 4.0).projections, means, atol=0.6)


def test_vertices_of_parabolas_and_the_standing_of_hypotheses() -> None:
    rng = np.random.default_rng(0)
    at, centres = np.array([-1.0, 0.0, 1.0]), rng.normal(0.3, 0.1, 400)
    found, spread = vertex(at, (at[:, None] - centres) ** 2 + 5)
    assert found == pytest.approx(centres.mean()) and spread == pytest.approx(0.1 / 20, rel=0.3)
    assert np.isnan(vertex(at, -np.ones((3, 1)) * (at[:, None] - centres) ** 2)[0])
    rng = np.random.default_rng(0)
    one = 1 + 0.01 * rng.random(30)
    other = one * (1.05 + 0.01 * rng.random(30))
    assert t_statistic(one, other) > 10 and t_statistic(one, other) == pytest.approx(-t_statistic(other, one))
    assert residual_ratio(one, other) == pytest.approx(1 / residual_ratio(other, one))
    assert t_statistic(one, one) == 0 and t_statistic(one[:2], other[:2]) == 0
