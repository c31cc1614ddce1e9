"""Matter that rays meet beyond the panel's sides, or outside of the stated grid, is taken for no other panel and no motion.

In a grid without a place for it, wrong geometries fit better: right scans had tilts of 34° and motions of 12°."""

from dataclasses import replace

import numpy as np
import pytest
from parallel_kit import BODIES, GRID, SIDE, line_integrals

from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Scan, pixel_centres
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, perturb
from phyradgs_cl.api import static_scan
from phyradgs_cl.calibrate import AGREES, CANNOT_TELL, CORRECTED, calibrate
from phyradgs_cl.calibrate.parameters import BEYOND_PANEL
from phyradgs_cl.calibrate.problem import CoarseProblem, Stage
from phyradgs_cl.calibrate.search import Reduced, Search
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

pytestmark = pytest.mark.slow

VIEWS, VOXEL_MM = 30, 0.78
WIDE = [((1, 2, -1), (10, 6, 7), 0.02), ((5, -1, 2), (1.5, 1.5, 1.5), 0.05), ((-4, 2, -2), (1, 2, 3), -0.015),
        ((0, 0, 3), (1.2, 0.8, 1), 0.06), ((2, 3, -3), (1, 1, 1), 0.04)]  # fmt: skip
TALL = [((0.3, -0.2, 0), (3.5, 3, 14), 0.03), ((1, 1, 6), (0.8, 0.8, 1), 0.05), ((-1, 0.5, -7), (1, 0.6, 1), 0.05),
        ((0, -1, 2), (0.8, 0.8, 0.8), 0.06), ((1, -1, -2), (0.6, 0.8, 0.6), 0.04)]  # fmt: skip
LOW = [((x, y, z - 6), *rest) for (x, y, z), *rest in WIDE]
PLANTED = GeometryCorrection(offset_u_mm=0.9, roll_rad=np.deg2rad(1.5))


def scan_of(bodies, shape, grid: Grid | None = None, photons: float = 1e5) -> Scan:
    """Closed-form line integrals, mean over 2 × 2 rays a pixel, with the noise of so many photons."""
    panel = ConeGeometry(60.0, 100.0, shape, (1.3, 1.3))
    fine = replace(panel, detector_shape=(2 * shape[0], 2 * shape[1]), pixel_size_mm=(0.65, 0.65))
    angles_deg = 360.0 / VIEWS * np.arange(VIEWS)
    pose = fine.pose(np.deg2rad(angles_deg))
    phantom = EllipsoidPhantom(tuple(Ellipsoid(*body) for body in bodies), "body")
    rays = phantom.line_integrals(pose[:, None, None, :3], pixel_centres(pose, fine.detector_shape))
    p = rays.reshape(VIEWS, shape[0], 2, shape[1], 2).mean((2, 4))
    counts = np.random.default_rng(0).poisson(photons * np.exp(-p))
    scan = static_scan(-np.log(counts / photons).astype(np.float32), panel, angles_deg)
    return replace(scan, grid=grid) if grid else scan


CASES = {
    "cut": lambda: scan_of(WIDE, (16, 12), photons=3e4), "tall": lambda: scan_of(TALL, (36, 14)),
    "a small grid": lambda: scan_of(TALL, (24, 14), Grid((20, 6, 6), (VOXEL_MM,) * 3)),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_right_scan_stays_and_planted_errors_are_found(rt, case) -> None:
    scan = CASES[case]()
    right = calibrate(scan, rt, "offset,roll,tilt")
    assert {one.verdict for one in right.parameters} <= {AGREES, CANNOT_TELL}
    found = calibrate(perturb(scan, replace(PLANTED, offset_u_mm=-PLANTED.offset_u_mm, roll_rad=-PLANTED.roll_rad)), rt)
    by_name = {one.name: one for one in found.parameters}
    offset, roll = by_name["offset-u"], by_name["roll"]
    assert offset.verdict == CORRECTED and abs(offset.found) < 3 * offset.deviation < 0.6
    assert abs(roll.found - 1.5) < 3 * roll.deviation
    assert all(by_name[name].verdict != CORRECTED for name in BEYOND_PANEL)
    assert found.residual_rms[1] < 0.5 * found.residual_rms[0]
    if case.startswith("cut"):
        assert all(by_name[name].found is None for name in BEYOND_PANEL)
        assert "offset-v, tilt-v, tilt-u: looks like matter beyond the panel's sides" in found.alike


@pytest.mark.parametrize("what", ["motion", "wobble"])
def test_a_cut_object_at_rest_does_not_move(rt, what) -> None:
    assert calibrate(CASES["cut"](), rt, what).corrected == []


@pytest.mark.parametrize(("bodies", "rows", "dead", "kept"), [
    (WIDE, 10, 0, (2, 8)), (TALL, 24, 0, (2, 22)), (TALL, 24, 3, (5, 22)), (WIDE, 28, 0, (0, 28)), (LOW, 28, 0, (2, 28)),
    (WIDE, 4, 0, (1, 3)), (WIDE, 1, 0, (0, 1)),
])  # fmt: skip
def test_rows_at_an_end_that_cuts_the_object_are_not_compared(rt, bodies, rows, dead, kept) -> None:
    """There a volume ends, which the object does not. ``dead``: the first rows that are masked."""
    mask = np.arange(rows)[:, None] < np.full((1, 28), dead)
    scan = replace(scan_of(bodies, (rows, 28)), pixel_mask=mask if dead else None)
    problem = CoarseProblem.of(rt, [scan], Stage(28, 1, 1))
    compared = problem.without_cut_ends()
    shown = compared.masked(np.ones_like(problem.measured))
    np.testing.assert_array_equal(np.flatnonzero(shown.any((0, 2))), np.arange(*kept))
    np.testing.assert_array_equal(compared.measured, shown * problem.measured)


@pytest.mark.parametrize(("so_mm", "up_mm", "roll_deg"), [(60, 0.0, 1.2), (0, 0.0, -1.0), (0, 0.7, 1.2)])
def test_a_roll_is_whole_though_the_first_or_last_row_cuts_the_object(rt, so_mm, up_mm, roll_deg) -> None:
    """A fifth to three quarters of it were found, as the edge of the volume did not turn with the panel."""
    shape = (20, SIDE)
    parallel = ParallelGeometry(shape, 0.1, (up_mm, 0.0))
    panel = ConeGeometry(so_mm, 1.4 * so_mm, shape, (0.14, 0.14), (up_mm, 0.0)) if so_mm else parallel
    scan = static_scan(np.zeros((40, *shape), np.float32), panel, 17 + 9.0 * np.arange(40), grid=GRID)
    truth = perturb(scan, GeometryCorrection(offset_u_mm=0.15, roll_rad=np.deg2rad(roll_deg))).trajectory
    poses = np.stack([truth.pose(frame, np.array(start_s)) for frame, start_s in enumerate(scan.frame_start_s)])
    if so_mm:
        frames = BODIES.line_integrals(poses[:, None, None, :3], pixel_centres(poses, shape))
    else:
        frames = np.stack([line_integrals(BODIES, pose, shape) for pose in poses])
    noisy = frames + np.random.default_rng(2).normal(0, 0.003, frames.shape)
    offset, roll = calibrate(replace(scan, projections=noisy.astype(np.float32)), rt, "offset-u,roll").parameters
    assert abs(offset.found - 0.15) < min(3 * offset.deviation, 0.005)
    assert abs(roll.found - roll_deg) < min(roll.deviation, 0.1 * abs(roll_deg))


def test_no_stand_leans_by_more_than_ten_degrees() -> None:
    """Without it, the rest is estimated again."""
    signals = np.eye(2, 60) + 0.5 * np.eye(2, 60, 1)
    problem = Reduced(("offset-u", "tilt-u"), np.ones(2), signals, np.ones(2), np.eye(2), np.zeros(60), 6, 1e-3)
    for tilt_rad, names in ((0.15, ("offset-u", "tilt-u")), (-0.2, ("offset-u",)), (1.1, ("offset-u",))):
        search = Search([], determined=problem.names)
        leaning = replace(problem, residual=np.array([0.4, tilt_rad]) @ signals)
        possible = search._possible(leaning)
        assert possible.names == search.determined == names
        assert possible.step()[0] == pytest.approx(leaning.only(names).step()[0])
