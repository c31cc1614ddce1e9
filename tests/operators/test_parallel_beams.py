"""Parallel beams: float64 twins and closed forms, in every build of the kernels."""

from dataclasses import dataclass

import numpy as np
import pytest
from kernel_kit import assert_near
from ray_tables import noise
from remembered import remembered
from tolerances import RAYS, RAYS_BACK, SPLAT_AFFINE, SPLAT_MOVING

from phyradgs_cl.acquisition import CircularOrbit, ConstantSpeed, ParallelGeometry, Shutter, pixel_centres
from phyradgs_cl.acquisition.cells import (
    common_time_cells,
    exact_cells,
    micro_view_cells,
    per_line_cells,
    static_cells,
)
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import RayOperator, backproject, backproject_lines
from phyradgs_cl.operators.splats.layout import DeviceCells
from phyradgs_cl.operators.splats.projector import SplatProjector
from phyradgs_cl.operators.twins.rays import backprojection, lines_backprojection, ray_frame, ray_volume
from phyradgs_cl.operators.twins.splat import moving_frame, splat_frame
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom, rotation_about_z

ray_frame, ray_volume, lines_backprojection = (remembered(twin) for twin in (ray_frame, ray_volume, lines_backprojection))
SHAPE = (24, 13)
GRID = Grid((12, 14, 11), (0.16, 0.13, 0.16), (0.1, -0.05, 0.2))
GEOMETRY = ParallelGeometry(SHAPE, (2.4 / 24, 2.6 / 13), (0.03, -0.04))


@dataclass(frozen=True)
class Leaning:
    """An orbit whose panel is rolled and whose rays rise: laminography for a large rise."""

    roll_rad: float
    rise_rad: float
    is_parallel = True

    def pose(self, frame: int, time_s: np.ndarray) -> np.ndarray:
        pose = CircularOrbit(GEOMETRY, ConstantSpeed(0.3, 0.9)).pose(frame, time_s).reshape(*np.shape(time_s), 4, 3)
        across, up = pose[..., 2, :].copy(), pose[..., 3, :] * GEOMETRY.pixel_size_mm[1] / GEOMETRY.pixel_size_mm[0]
        pose[..., 2, :] = np.cos(self.roll_rad) * across + np.sin(self.roll_rad) * up
        pose[..., 3, :] += np.tan(self.roll_rad) * -across * GEOMETRY.pixel_size_mm[0] / GEOMETRY.pixel_size_mm[1]
        pose[..., 0, :] = np.cos(self.rise_rad) * pose[..., 0, :] + [0, 0, np.sin(self.rise_rad)]
        return pose.reshape(*np.shape(time_s), 12)


BEAMS = {
    "upright": Leaning(0.0, 0.0), "rolled": Leaning(0.03, 0.0), "rising": Leaning(0.02, -0.2),
    "laminography": Leaning(0.0, 1.0),
}  # fmt: skip


def cells_of(trajectory, motion: str, axis: str = "rows", shape: tuple[int, int] = SHAPE) -> list[TimeCells]:
    shutter, start_s = Shutter(0.4, 0.3, axis), np.array([0.1, 1.6])
    lines, builders = shutter.lines(shape), {"micro-views": (micro_view_cells, 3, 2), "own": (per_line_cells, 2)}
    tables = []
    for frame in range(2):
        where = trajectory, shutter, frame
        if motion == "common":
            tables.append(common_time_cells(*where, start_s, lines, 2))
        else:
            build, *counts = builders.get(motion, (exact_cells, 3) if motion == "exact" else (static_cells,))
            tables.append(build(*where, start_s[frame], lines, *counts))
    return tables


@pytest.mark.parametrize(("beam", "motion", "axis"), [
    ("upright", "static", "rows"), ("rising", "static", "rows"), ("laminography", "common", "columns"),
    ("rolled", "common", "columns"), ("rising", "own", "rows"), ("upright", "common", "rows"),
])  # fmt: skip
def test_rays_and_their_adjoint_are_the_twins(two_rt, beam: str, motion: str, axis: str) -> None:
    tables, volume = cells_of(BEAMS[beam], motion, axis)[: 1 if motion == "own" else 2], noise(GRID.shape, 1)
    frames = noise((len(tables), *SHAPE), 2)
    operator = RayOperator(two_rt, GRID, SHAPE, tables)
    there, back = operator.forward(volume), operator.adjoint(frames)
    assert_near(there, np.stack([ray_frame(volume, GRID, table, SHAPE) for table in tables]), RAYS)
    assert_near(back, sum(ray_volume(y, GRID, table) for y, table in zip(frames, tables, strict=True)), RAYS_BACK)


@pytest.mark.parametrize("angle_deg", [45, 135, 225, 315])
def test_rays_along_a_diagonal_of_voxels(two_rt, angle_deg: int) -> None:
    """Which axis is the main one, float64 and float32 must answer alike: at 135° cosine and sine differ in the last bit."""
    grid, volume, frames = Grid((12, 11, 11), (0.16,) * 3), noise((12, 11, 11), 1), noise((1, *SHAPE), 2)
    orbit = CircularOrbit(GEOMETRY, ConstantSpeed(np.deg2rad(angle_deg), 0.0))
    table = static_cells(orbit, Shutter(0.4, 0.3), 0, 0.1, SHAPE[0])
    operator = RayOperator(two_rt, grid, SHAPE, [table])
    assert_near(operator.forward(volume)[0], ray_frame(volume, grid, table, SHAPE), RAYS)
    assert_near(operator.adjoint(frames), ray_volume(frames[0], grid, table), RAYS_BACK)


def test_panels_of_parallel_beams_take_the_upright_kernels(banded_rt) -> None:
    kinds = {name: RayOperator(banded_rt, GRID, SHAPE, cells_of(beam, "static"))._upright for name, beam in BEAMS.items()}
    assert kinds["laminography"] is None
    leans = [kinds[name].leans for name in ("upright", "rolled", "rising")]
    assert leans == [False, True, True]


def test_an_ellipsoids_projection_halves_its_error_with_the_voxel(rt) -> None:
    body = Ellipsoid((0.1, -0.05, 0.08), (0.7, 0.5, 0.6), 1.0, rotation_about_z(0.4))
    phantom, errors = EllipsoidPhantom((body,), "one"), []
    (cells,) = cells_of(CircularOrbit(GEOMETRY, ConstantSpeed(0.3, 0.9)), "static")[:1]
    pixels, along = pixel_centres(cells.pose[0], SHAPE), 5 * cells.pose[0, :3]
    exact = phantom.line_integrals(pixels - along, pixels + along)
    for n in (24, 48):
        grid = Grid((n, n, n), (2 / n,) * 3)
        frame = RayOperator(rt, grid, SHAPE, [cells]).forward(phantom.voxelise(grid, 4))[0]
        errors.append(np.linalg.norm(frame - exact) / np.linalg.norm(exact))
    assert errors[1] < 0.04 and errors[1] < 0.65 * errors[0]


@pytest.mark.parametrize(
    ("beam", "motion"), [("laminography", "static"), ("upright", "micro-views"), ("rising", "exact")]
)
def test_splats_and_their_gradients_are_the_twins(two_rt, make_cloud, beam: str, motion: str) -> None:
    rows, (table, _), h = make_cloud(4), cells_of(BEAMS[beam], motion), noise(SHAPE, 5)
    projector = SplatProjector(two_rt, *SHAPE, cutoff_sigma=0.0, time_error=1e-6)
    cells, twin = DeviceCells.upload(two_rt, table), moving_frame if motion == "exact" else splat_frame
    limit = SPLAT_MOVING if motion == "exact" else SPLAT_AFFINE
    assert_near(projector.project(rows, cells), twin(rows, table, SHAPE), limit)
    by_rows = projector.project_adjoint(rows, cells, h)
    step = 1e-5 * np.random.default_rng(6).normal(size=rows.shape)
    change = ((twin(rows + step, table, SHAPE) - twin(rows - step, table, SHAPE)) * h).sum()
    size = np.abs(2 * by_rows * step).sum()
    assert abs((2 * by_rows * step).sum() - change) <= 2e-5 * size


def test_backprojections_are_the_twins(two_rt) -> None:
    frames, weight, angles = noise((3, *SHAPE), 7), np.array([0.5, 0.8, 1.0]), np.array([0.0, 1.3, 2.9])
    pose = GEOMETRY.pose(angles)
    expected = backprojection(frames, pose, weight, GRID, True)
    assert_near(backproject(two_rt, frames, pose, weight, GRID, is_parallel=True), expected, RAYS_BACK)
    for axis, lines in (("rows", SHAPE[0]), ("columns", SHAPE[1])):
        poses = np.stack([GEOMETRY.pose(a + np.linspace(-0.1, 0.1, lines)) for a in angles])
        expected = lines_backprojection(frames, poses, weight, GRID, axis, True)
        assert_near(backproject_lines(two_rt, frames, poses, weight, GRID, axis, is_parallel=True), expected, RAYS_BACK)
