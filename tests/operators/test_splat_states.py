"""Splats of an object that moves: twins, gradients, a rigid field as a moved scanner, motion within an exposure."""

from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import assert_classes, assert_near, by_gaussian, frame_cells, random_weights, splat
from scipy.spatial.transform import Rotation
from tolerances import FLOAT32, GRADIENT, MERGED_FRAME, SPLAT_MOVING

from phyradgs_cl.acquisition import CircularOrbit, ConstantSpeed, ParallelGeometry, Shutter
from phyradgs_cl.acquisition.cells import exact_cells, per_line_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector
from phyradgs_cl.operators.splats.states import STATE_ROWS, CloudStates, segments_for_object, states_of
from phyradgs_cl.operators.twins.rays import deformed_frame
from phyradgs_cl.runtime import Runtime

SHAPE = (13, 18)
TIMES_S = np.array([0.0, 0.6, 1.1, 2.0])


def deformation(size: float = 0.1, rank: int = 2, spacing: float = 0.5) -> Deformation:
    """A smooth random field that ends within the clouds, whose weights change during a frame."""
    control = np.random.default_rng(1).normal(scale=size, size=(rank, 4, 5, 3, 3))
    weights = np.stack([np.cos(2.0 * TIMES_S - r) for r in range(rank)], -1)
    return Deformation(control, (-0.6, -1.0, -0.8), (spacing, spacing, 0.9 * spacing), TIMES_S, weights)


def projector(rt: Runtime, table: TimeCells, one: Deformation, **options: object) -> tuple[SplatProjector, DeviceCells]:
    options = {"cutoff_sigma": 0.0, "time_error": 1e-9, **options}
    frame = SplatProjector(rt, *table.readout.shape(SHAPE), states=CloudStates(rt, one), **options)
    return frame, DeviceCells.upload(rt, table, states_of(table, one))


def render(rt, rows, table, one, **options) -> np.ndarray:
    frame, cells = projector(rt, table, one, **options)
    return table.readout.frames(frame.project(rows, cells))


def gradients(rt, rows, table, one, h, **options) -> np.ndarray:
    frame, cells = projector(rt, table, one, **options)
    return frame.project_adjoint(rows, cells, table.readout.frames(h).astype(np.float32))


def check_frame_and_gradients(rt, finite_differences, rows, table, one, affine=False, **options) -> None:
    def twin(r: np.ndarray) -> np.ndarray:
        return deformed_frame(r, table, SHAPE, one, affine)

    h = random_weights(SHAPE)
    assert_near(render(rt, rows, table, one, affine=affine, **options), twin(rows), SPLAT_MOVING)
    found = gradients(rt, rows, table, one, h, affine=affine, **options)
    assert_classes(found, by_gaussian(finite_differences, lambda r: (h * twin(r)).sum(), rows), GRADIENT)


@pytest.mark.parametrize("count", [0, 1, 3, 37])
def test_a_cloud_in_every_state_is_its_twin(two_rt, make_cloud, make_geometry, count) -> None:
    """Also outside of the control points, where it rests."""
    rows, one = make_cloud(count, 3, spread=1.5), deformation()
    table = frame_cells("micro-views", make_geometry(*SHAPE))
    cells, gaussians = DeviceCells.upload(two_rt, table, states_of(table, one)), DeviceGaussians.upload(two_rt, rows)
    moved = two_rt.download(CloudStates(two_rt, one).forward(gaussians, cells.shares))
    weights = one.weights_at(np.unique(table.time_s))
    assert moved.shape == (len(weights), STATE_ROWS, gaussians.stride)
    for state, expected in zip(moved[..., :count], weights, strict=True):
        twin = rows[:3].T + one.inverse_mm(rows[:3].T, expected)
        pull = np.eye(3) + one.jacobian(twin, expected)
        np.testing.assert_allclose(state[:3].T, twin, rtol=0, atol=FLOAT32)
        np.testing.assert_allclose(state[3:].T, pull.reshape(-1, 9), rtol=0, atol=FLOAT32)


@pytest.mark.slow
@pytest.mark.parametrize(("motion", "counts", "beam", "affine"), [
    ("micro-views", (2, 2), "cone", False), ("micro-views", (2, 2), "cone", True), ("exact", (2,), "cone", False),
    ("exact", (1,), "cone", True), ("static", (), "parallel", False), ("exact", (1,), "parallel", False),
])  # fmt: skip
def test_frames_and_gradients_are_those_of_the_twin(
    rt, make_cloud, make_geometry, finite_differences, motion, counts, beam, affine
) -> None:
    parallel = ParallelGeometry(SHAPE, (2.6 / 13, 2.7 / 18))
    table = frame_cells(motion, make_geometry(*SHAPE, offset=(0.15, -0.25)) if beam == "cone" else parallel, *counts)
    rows = make_cloud(2 if motion == "micro-views" and not affine else 1, 41, scale=(0.05, 0.3))
    check_frame_and_gradients(rt, finite_differences, rows, table, deformation(), affine)


@pytest.mark.slow
def test_in_every_build(any_rt, make_cloud, make_geometry, finite_differences) -> None:
    table = frame_cells("exact", make_geometry(*SHAPE), 1, shutter=Shutter(0.8, 0.6, "columns", -1))
    check_frame_and_gradients(any_rt, finite_differences, make_cloud(1, 42), table, deformation(rank=1))


@pytest.mark.parametrize("motion", ["micro-views", "exact"])
def test_a_rigid_field_is_a_moved_scanner(rt, make_cloud, make_geometry, motion) -> None:
    """The reference at y + w(y) = Q y + d is the object at y: a scanner that has turned by Q and moved by d sees it."""
    rows, table = make_cloud(20, 46), frame_cells(motion, make_geometry(*SHAPE))
    turn, shift = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix(), np.array([0.1, -0.2, 0.15])
    z, y, x = np.meshgrid(*[np.linspace(-4, 4, 17)] * 3, indexing="ij")
    points = np.stack([x, y, z], -1)
    one = Deformation((points @ turn.T + shift - points)[None], (-4.0,) * 3, 0.5, np.zeros(1), np.ones((1, 1)))

    def moved(pose: np.ndarray) -> np.ndarray:
        vectors = pose.reshape(*pose.shape[:-1], 4, 3) @ turn.T
        vectors[..., :2, :] += shift
        return vectors.reshape(pose.shape)

    ends = None if table.end_poses is None else moved(table.end_poses)
    scanner = replace(table, pose=moved(table.pose), end_poses=ends)
    expected = splat(rt, rows, scanner, SHAPE, cutoff_sigma=0.0, time_error=1e-9)
    assert_near(render(rt, rows, table, one), expected, MERGED_FRAME)


def test_motion_within_an_exposure_is_followed_and_bent_paths_get_more_segments(rt, make_cloud, make_geometry) -> None:
    """A gantry that hardly turns, and an object that moves at constant speed: one segment has what thirty times have, but
    for conics that are those of its middle."""
    orbit, times_s = CircularOrbit(make_geometry(*SHAPE), ConstantSpeed(0.3, 1e-3)), np.linspace(0, 2, 81)
    steady = Deformation(0.1 * np.ones((1, 11, 11, 11, 3)), (-2.5,) * 3, 0.5, np.array([0.0, 2.0]), np.array([[0.0], [1.0]]))
    where, rows = (orbit, Shutter(0.8, 0.6), 0, 0.2, SHAPE[0]), make_cloud(8, 47)
    one = render(rt, rows, exact_cells(*where, 1), steady)
    many = render(rt, rows, per_line_cells(*where, 30), steady)
    still = render(rt, rows, static_cells(*where), steady)
    assert np.linalg.norm(one - many) <= 0.1 * np.linalg.norm(still - many)
    swing = Deformation(0.2 * np.ones((1, 11, 11, 11, 3)), (-2.5,) * 3, 0.5, times_s, np.cos(4 * times_s)[:, None])
    lit_s = 0.2 + np.array([0.0, 1.4])
    assert segments_for_object(deformation(0.0), lit_s, 0.1) == 1
    count = segments_for_object(swing, lit_s, 0.1)
    many = render(rt, rows, per_line_cells(*where, 30), swing)
    one, several = (np.linalg.norm(render(rt, rows, exact_cells(*where, n), swing) - many) for n in (1, count))
    assert count > 2 and several < 0.1 * one


def test_cells_that_do_not_fit_and_fields_without_an_inverse_are_refused(rt, make_geometry) -> None:
    with pytest.raises(InputError, match="--motion centres"):
        states_of(frame_cells("centres", make_geometry(*SHAPE)), deformation())
    table = replace(frame_cells("exact", make_geometry(*SHAPE)), end_times_s=None)
    with pytest.raises(InputError, match="end_times_s"):
        states_of(table, deformation())
    CloudStates(rt, deformation()).check_inverse(Grid.cube(16, 2.0))
    with pytest.raises(InputError, match="without an inverse"):
        CloudStates(rt, deformation(2.0)).check_inverse(Grid.cube(16, 2.0))
