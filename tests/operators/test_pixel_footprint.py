"""The pixel's footprint: splats widened by a pixel's variance, against the twin, a fine detector, and differences."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import CLASSES, MODELS, assert_near, frame_cells, random_weights
from remembered import remembered
from tolerances import FOOTPRINT_AREA, FOOTPRINT_MASS, GRADIENT, SPLAT_MOVING

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector
from phyradgs_cl.operators.twins.splat import moving_frame, splat_image
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.layout import pad_rows

SHAPE = (13, 18)
PIXEL_VARIANCE = 1 / 12
MOTIONS = pytest.mark.parametrize("motion", ["static", "exact"])
SMALL = (0.01, 0.3)  # from a thirtieth of a pixel


def at_rest(table: TimeCells) -> TimeCells:
    """A static table as segments in which nothing moves, which is what the twin reads."""
    times = np.zeros((table.count, 3, table.lines))
    times[:, 2] = 1
    return replace(table, end_poses=np.stack([table.pose, table.pose], 1), line_times=times)


@pytest.fixture
def make_table(make_geometry) -> Callable[[str], TimeCells]:
    return lambda motion: frame_cells(motion, make_geometry(*SHAPE, offset=(0.15, -0.25)))


@remembered
def twin(rows: np.ndarray, table: TimeCells, affine: bool = False) -> np.ndarray:
    moving = table if table.end_poses is not None else at_rest(table)
    return moving_frame(rows, moving, SHAPE, affine=affine, pixel_variance=PIXEL_VARIANCE)


def projector(rt: Runtime, shape: tuple[int, int] = SHAPE, **options: object) -> SplatProjector:
    return SplatProjector(rt, *shape, cutoff_sigma=0.0, time_error=1e-6, **options)


@MODELS
@MOTIONS
def test_every_build_is_the_twin(any_rt, make_cloud, make_table, motion, affine) -> None:
    rows, table = make_cloud(5, 51, scale=SMALL), make_table(motion)
    sharp, wide = (
        projector(any_rt, affine=affine, pixel_footprint=on).project(rows, DeviceCells.upload(any_rt, table))
        for on in (False, True)
    )
    expected = twin(rows, table, affine)
    assert_near(wide, expected, SPLAT_MOVING)
    assert np.abs(sharp - wide).max() > 0.1 * expected.max()


@pytest.mark.parametrize(("motion", "affine"), [("exact", False), ("static", True)])
def test_gradients(any_rt, make_cloud, make_table, finite_differences, motion, affine) -> None:
    rows, table, h = make_cloud(3, 52, scale=(0.02, 0.3)), make_table(motion), random_weights(SHAPE)
    wide, cells = projector(any_rt, affine=affine, pixel_footprint=True), DeviceCells.upload(any_rt, table)
    found = wide.project_adjoint(rows, cells, h.astype(np.float32))
    for g, row in enumerate(rows.T):
        expected = finite_differences(lambda r: float((h * twin(r[:, None], table, affine)).sum()), row)
        for name, part in CLASSES.items():
            wrong, size = np.linalg.norm(found[part, g] - expected[part]), np.linalg.norm(expected[part])
            assert wrong <= GRADIENT * max(size, 1e-3 * np.linalg.norm(expected)), name


def round_splat(scale: float, x: float) -> np.ndarray:
    return np.array([[x, 0.013, 0.021, scale, scale, scale, 1, 0, 0, 0, 1.0]]).T


@pytest.mark.parametrize("pixels", [0.05, 0.3, 0.5, 1.0, 3.0])
def test_pixels_with_an_area_see_the_mean_over_it(rt, pixels) -> None:
    """A round splat of ``pixels`` pixels (σ), against the mean of 15 × 15 rays per pixel."""
    shape, fine = (31, 33), 15
    coarse = ConeGeometry(5.0, 7.5, shape, (0.1, 0.1))
    rays = ConeGeometry(5.0, 7.5, (shape[0] * fine, shape[1] * fine), (0.1 / fine, 0.1 / fine))
    rows = round_splat(pixels * 0.1 / 1.5, 0.007)
    where = (ConstantSpeed(0.0, 0.5), Shutter(0.1, 0.0, "rows", 1))
    table = static_cells(CircularOrbit(coarse, where[0]), where[1], 0, 0.0, shape[0])
    seen = projector(rt, shape, pixel_footprint=True).project(rows, DeviceCells.upload(rt, table))
    points = projector(rt, shape).project(rows, DeviceCells.upload(rt, table))
    dense = splat_image(rows, CircularOrbit(rays, where[0]).pose(0, np.array(0.05)), rays.detector_shape)
    area = dense.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))
    assert abs(seen.sum() / area.sum() - 1) <= FOOTPRINT_MASS[pixels]
    if pixels >= 0.3:
        wide, narrow = (np.linalg.norm(image - area) / np.linalg.norm(area) for image in (seen, points))
        assert wide <= FOOTPRINT_AREA[pixels] and wide < narrow / 2


def test_needles_and_specks_stay_finite(rt, make_table, finite_differences) -> None:
    rows = np.concatenate([round_splat(1e-6, 0.1), round_splat(1.0, 0.0)], axis=1)
    rows[3:6, 1] = (1e-6, 1e-6, 1.0)
    cells, gaussians = DeviceCells.upload(rt, make_table("exact")), DeviceGaussians.upload(rt, rows)
    splat = projector(rt, pixel_footprint=True)
    image = rt.download(splat.forward(gaussians, cells))
    gradients = rt.zeros((13, gaussians.stride))
    splat.backward(gaussians, cells, rt.upload(pad_rows(np.ones(SHAPE, np.float32))), gradients)
    assert np.isfinite(image).all() and np.isfinite(rt.download(gradients)).all()
    assert image.max() > 0
