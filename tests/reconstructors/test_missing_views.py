"""FDK and FBP of turns in which views are missing: densities stay, or one line says by which angles they cannot."""

from dataclasses import replace

import numpy as np
import pytest
from balls import balls, frames_of
from balls import levels as levels_in
from tolerances import FDK_PARTIAL, FLOAT64

from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Scan, Shutter
from phyradgs_cl.api import reconstruct, static_scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.fdk import fdk_volume, weights
from phyradgs_cl.reconstructors.fdk.arc import view_arc

GRID = Grid((16, 32, 32), (0.0625,) * 3)
PHANTOM = balls(((0.5, 0.1, 0.1), 0.28), ((-0.35, 0.4, -0.1), 0.25), ((-0.15, -0.5, 0), 0.25), ((0, 0, 0), 0.2))
EVERY_DEG = 2.0 * np.arange(180)


def levels(rt, kind: str, angles_deg: np.ndarray, columns: int = 48, offset_mm: float = 0.0, lines_deg: float = 0.0):
    """Of a cone or parallel beam that sees ±(columns / 40 mm) about its middle at the axis, and turns by ``lines_deg`` while
    a frame is read."""
    shape, is_parallel = (30, columns), kind == "fbp"
    cone = ConeGeometry(6.0, 9.0, shape, 0.075, (0.0, 1.5 * offset_mm))
    geometry = ParallelGeometry(shape, 0.05, (0.0, offset_mm)) if is_parallel else cone
    lines_deg = lines_deg * (np.arange(30) / 30 - 0.5)
    pose = geometry.pose(np.deg2rad(angles_deg[:, None] + lines_deg if lines_deg.any() else angles_deg))
    frames = frames_of(PHANTOM, pose, shape, is_parallel=is_parallel)
    return levels_in(PHANTOM, fdk_volume(rt, frames, pose, GRID, is_parallel=is_parallel), GRID)


@pytest.mark.parametrize("kind", ["fdk", "fbp"])
@pytest.mark.parametrize("lines_deg", [0.0, pytest.param(1.5, marks=pytest.mark.slow)])
def test_a_displaced_panel_keeps_its_weights_where_views_are_missing(rt, kind, lines_deg, caplog) -> None:
    """They went, and the density at the axis was three times too high: two views in a row, or a turn that ends early."""
    turns = {"whole": EVERY_DEG, "two lost": np.delete(EVERY_DEG, [40, 41]), "ends early": np.arange(0, 359, 1.0)}
    whole = levels(rt, kind, EVERY_DEG, 30, 0.45, lines_deg)
    for name, angles in turns.items():
        np.testing.assert_allclose(levels(rt, kind, angles, 30, 0.45, lines_deg), whole, atol=FDK_PARTIAL / 2, err_msg=name)
    assert [record.message.split(" are missing")[0] for record in caplog.records] == [f"{kind.upper()}: 4.0°"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fdk", "fbp"])
@pytest.mark.parametrize("offset_mm", [0.0, 0.02])
def test_a_panel_that_sees_both_sides_takes_missing_rays_from_opposite_views(rt, kind, offset_mm, caplog) -> None:
    gaps = {"one": [(20, 50)], "two": [(20, 35), (80, 95)], "three": [(5, 20), (60, 75), (123, 137)]}
    whole = levels(rt, kind, EVERY_DEG, 52, offset_mm)
    for name, lost in gaps.items():
        angles = np.delete(EVERY_DEG, np.concatenate([np.arange(*ends) for ends in lost]))
        np.testing.assert_allclose(levels(rt, kind, angles, 52, offset_mm), whole, atol=FDK_PARTIAL, err_msg=name)
    assert not caplog.records


@pytest.mark.parametrize(("kind", "views"), [("fdk", 115), ("fbp", 90)])
def test_half_a_turn_beside_a_displaced_panel_is_a_short_scan(rt, kind, views, caplog) -> None:
    """The views at its ends stood for the other half, which cost up to 10 dB. All that the shorter side sees is right."""
    whole = levels(rt, kind, EVERY_DEG, 52, 0.2)
    np.testing.assert_allclose(levels(rt, kind, EVERY_DEG[:views], 52, 0.2), whole, atol=FDK_PARTIAL)
    (record,) = caplog.records
    within = {"fdk": "1.08", "fbp": "1.1"}[kind]
    assert f"from {2 * views}.0° the volume is right within {within} mm of the axis" in record.message


FEW, JITTER = 12.0 * np.arange(30), np.random.default_rng(1).normal(0, 0.05, 60)


@pytest.mark.parametrize(("kind", "angles_deg", "same_deg"), [
    ("fdk", np.tile(FEW, 2) + JITTER, FEW), ("fbp", np.tile(FEW, 2) + JITTER, FEW),
    ("fbp", 15.5 * np.arange(12), 15.0 * np.arange(12)),
])  # fmt: skip
def test_views_that_come_again_with_jitter_and_few_beyond_half_a_turn_do_not_count_twice(rt, kind, angles_deg, same_deg):
    """Every step between two of them was a gap, and densities went wrong by half. What half a step beyond half a turn of
    parallel rays measures again made them 3.5 % too high."""
    found, expected = (levels(rt, kind, angles, 52) for angles in (angles_deg, same_deg))
    np.testing.assert_allclose(found, expected, atol=FDK_PARTIAL)


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_columns_that_are_always_masked_make_a_narrower_panel(rt, axis) -> None:
    """Their continued values stood for the object: a density was a quarter too low."""
    geometry = ConeGeometry(6.0, 9.0, (30, 52), 0.075)
    pose = geometry.pose(np.deg2rad(4.0 * np.arange(90)))
    frames, mask = frames_of(PHANTOM, pose, (30, 52)), np.zeros((30, 52))
    mask[:, :12] = 1
    cut = ConeGeometry(6.0, 9.0, (30, 40), 0.075, (0.0, 0.45))
    masked = static_scan(np.where(mask, 5.0, frames), geometry, 4.0 * np.arange(90), mask=mask, grid=GRID)
    narrow = static_scan(frames[:, :, 12:], cut, 4.0 * np.arange(90), grid=GRID)
    if axis == "columns":
        masked, narrow = (replace(one, shutter=Shutter(0.1, 0.1, "columns"), is_fly=True) for one in (masked, narrow))
    volumes = [reconstruct(scan, "fdk", device=rt, report=False).volume for scan in (masked, narrow)]
    np.testing.assert_allclose(*volumes, atol=1e-5)


def test_frames_that_are_masked_for_the_most_part_are_left_out(rt) -> None:
    """One pixel that was left stood for the whole frame."""
    geometry, angles = ConeGeometry(6.0, 9.0, (30, 52), 0.075), 4.0 * np.arange(90)
    frames, mask = frames_of(PHANTOM, geometry.pose(np.deg2rad(angles)), (30, 52)), np.zeros((90, 30, 52))
    mask[10:60:10] = 1
    volumes = []
    for kept in (0, 1):
        mask[10:60:10, 15, 26] = 1 - kept
        scan = static_scan(frames, geometry, angles, mask=mask, grid=GRID)
        volumes.append(reconstruct(scan, "fdk", device=rt, report=False).volume)
    np.testing.assert_array_equal(*volumes)


def test_panels_that_stand_in_two_places_and_approximations_are_warned_of(rt, caplog) -> None:
    """By the API, which looks at the scan before: a look's warnings, which are silenced, counted as said."""
    aside = (ConeGeometry(6.0, 9.0, (30, 40), 0.075, (0.0, offset)) for offset in (0.45, -0.45))
    pose = np.concatenate([one.pose(np.deg2rad(EVERY_DEG[::4])) for one in aside])
    pose[:, 2] += 1.5  # the source above the plane
    scan = Scan.from_poses(frames_of(PHANTOM, pose, (30, 40)), pose, GRID)
    reconstruct(scan, "fdk", device=rt, report=False)
    assert "the panel stands elsewhere in some views" in caplog.text and "above the middle of their circle" in caplog.text


@pytest.mark.slow
def test_gaps_that_nothing_covers_are_named(rt, caplog) -> None:
    """In degrees, in one line each. Views that are denser in one half lack nothing."""
    denser = np.concatenate([np.arange(0, 180, 3.6), np.arange(180, 360, 12.0)])
    opposite = np.delete(EVERY_DEG, np.r_[20:40, 110:130])
    cases = (
        ("fdk", denser, 48, 0.0, ""),
        ("fdk", opposite, 52, 0.0, "FDK: the views cover 280.0° in 2 parts, which leave"),
        ("fbp", opposite, 52, 0.0, "FBP: the views cover 280.0° in 2 parts, which leave"),
        ("fdk", EVERY_DEG[:150], 30, 0.45, "FDK: 60.0° are missing where a displaced detector needs a full turn"),
        ("fbp", EVERY_DEG[:150], 30, 0.45, "FBP: 60.0° are missing where a displaced detector needs a full turn"),
        ("fdk", EVERY_DEG, 30, 0.74, "FDK: the panel ends 0.20 pixels beyond the axis"),
        ("fbp", EVERY_DEG, 30, -0.68, "FBP: the panel ends 1.40 pixels beyond the axis"),
    )
    for kind, angles, columns, offset_mm, message in cases:
        caplog.clear()
        levels(rt, kind, angles, columns, offset_mm)
        assert [record.message[: len(message)] for record in caplog.records] == [message] * bool(message)


def test_a_ray_and_its_opposite_in_a_scan_of_parts_count_two() -> None:
    """Parts end half a step beyond their views; cells of a displaced panel sum to a turn all the same."""
    angles = np.deg2rad(np.delete(EVERY_DEG, np.r_[20:30, 90:95]))
    assert view_arc(angles, 2 * np.pi).gap_rad.sum() == pytest.approx(2 * np.pi, rel=FLOAT64)
    rng, parted = np.random.default_rng(3), view_arc(angles)
    np.testing.assert_allclose(np.rad2deg(parted.parts_rad), [[0, 120], [130, 340]], rtol=FLOAT64)
    for angle, here in zip(rng.uniform(-0.1, 0.1, 300), rng.choice(parted.progress_rad, 300), strict=True):
        there = (here + np.pi + 2 * angle) % (2 * np.pi)
        both = weights.parted_weight(here, np.array(angle), parted.parts_rad)
        if parted.covers(np.array(there)):
            both = both + weights.parted_weight(there, np.array(-angle), parted.parts_rad)
        assert float(both) == pytest.approx(2.0, abs=1e-3)
