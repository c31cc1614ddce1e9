"""Warps of a volume and projectors of a moving object: twins, transposes, derivatives, and the same bits at rest."""

from dataclasses import replace

import numpy as np
import pytest
import scipy
from kernel_kit import assert_near
from ray_tables import noise
from tolerances import ADJOINT, FLOAT32, GRIDDED_FIELD, RAYS

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import common_time_cells, static_cells
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import OutOfMemoryError
from phyradgs_cl.fields import Deformation, Grid, control_points, deformed
from phyradgs_cl.operators import IntensityOperator, RayOperator
from phyradgs_cl.operators.bricks import whole
from phyradgs_cl.operators.rays.memory import RayMemory
from phyradgs_cl.operators.twins.rays import backprojection, warp_adjoint, warp_forward
from phyradgs_cl.operators.warp.backproject import MovingBackprojector
from phyradgs_cl.operators.warp.operator import FieldDerivative, WarpedOperator, projector_of, warp_slopes
from phyradgs_cl.operators.warp.states import MOST_STATES, MotionStates
from phyradgs_cl.operators.warp.volume import VolumeWarp
from phyradgs_cl.runtime import Runtime

GRID = Grid((11, 9, 21), (0.2, 0.25, 0.1), (0.1, -0.05, 0.0))
SHAPE = (12, 16)
GEOMETRY = ConeGeometry(5.0, 7.5, SHAPE, (0.35, 0.3))
TIMES_S = np.linspace(0.0, 6.0, 25)
STEP = 1e-5  # of differences: voxels, or of a unit of weight


def deformation(size_mm: float, rank: int = 2, seed: int = 0) -> Deformation:
    """A smooth random field, and weights on a loop."""
    origin_mm, counts = control_points(GRID, 0.6)
    control_mm = np.random.default_rng(seed).normal(scale=size_mm, size=(rank, *counts, 3))
    phases = 2 * np.pi * (TIMES_S[:, None] / 4.0 - np.arange(rank) / (2 * rank))
    return Deformation(control_mm, origin_mm, 0.6, TIMES_S, np.cos(phases))


def tables(frames: int = 4) -> list[TimeCells]:
    orbit, shutter = CircularOrbit(GEOMETRY, ConstantSpeed(0.3, 1.0)), Shutter(0.8, 0.6)
    start_s = 1.2 * np.arange(frames)
    return [common_time_cells(orbit, shutter, f, start_s, SHAPE[0], 3) for f in range(frames)]


def states_of(one: Deformation) -> MotionStates:
    return MotionStates.of_times(one, GRID, TIMES_S)


def adjoint(warp: VolumeWarp, state: int, values: np.ndarray) -> np.ndarray:
    warp.rt.write(warp.moved(), values)
    total, result = warp.zeros(), warp.rt.empty(GRID.shape)
    warp.adjoint(state, warp.moved(), total)
    warp.read(total, result)
    return warp.rt.download(result)


@pytest.mark.parametrize("size_mm", [0.02, 0.3, 5.0])  # neighbours that move together, that part, far outside
def test_warps_are_their_twins_and_have_exact_transposes(two_rt, size_mm) -> None:
    states = states_of(deformation(size_mm))
    warp, volume = VolumeWarp(two_rt, states), noise(GRID.shape)
    displacement = np.tensordot(states.weights[1], states.fields_mm, 1) / GRID.voxel_size_mm[::-1]
    moved = two_rt.download(warp.forward(1, warp.source(two_rt.upload(volume))))
    assert_near(moved, warp_forward(volume, displacement), FLOAT32)
    assert_near(adjoint(warp, 1, volume), warp_adjoint(volume, displacement), FLOAT32)
    x, y = noise(GRID.shape, 2) - np.float32(0.5), noise(GRID.shape, 3) - np.float32(0.5)  # sums that nearly cancel
    forward = two_rt.download(warp.forward(0, warp.source(two_rt.upload(x)))).astype(np.float64)
    size = np.linalg.norm(forward) * np.linalg.norm(y)
    assert abs(np.vdot(forward, y) - np.vdot(x.astype(np.float64), adjoint(warp, 0, y))) <= ADJOINT * size


def warped(rt: Runtime, one: Deformation, cells: list[TimeCells]) -> WarpedOperator:
    operator = projector_of(rt, GRID, cells, one)(rt, GRID, SHAPE, cells)
    assert isinstance(operator, WarpedOperator)
    return operator


def test_the_projector_is_the_sum_over_states_and_has_its_transpose(rt) -> None:
    cells = tables()
    operator = warped(rt, deformation(0.1), cells)
    states, x, y = operator.warp.states, noise(GRID.shape), noise((4, *SHAPE), 2)
    forward, backward = operator.forward(x), operator.adjoint(y)
    one, other = np.vdot(forward.astype(np.float64), y), np.vdot(x.astype(np.float64), backward)
    assert abs(one - other) <= ADJOINT * abs(one)
    fields = states.fields_mm / GRID.voxel_size_mm[::-1]
    moved = [warp_forward(x, np.tensordot(w, fields, 1)).astype(np.float32) for w in states.weights]
    for frame, table in enumerate(cells):
        shares, expected = states.shares(table.time_s), np.zeros(SHAPE)
        for cell in range(table.count):
            alone = TimeCells(
                table.pose[[cell]], table.time_s[[cell]], table.line_start[[cell]], table.line_stop[[cell]],
                table.weight[[cell]], table.lines, line_share=table.line_share[[cell]],
            )  # fmt: skip
            of_cell = RayOperator(rt, GRID, SHAPE, [alone])
            expected += sum(share * of_cell.forward(v)[0] for share, v in zip(shares[cell], moved, strict=True) if share)
        assert_near(forward[frame], expected, 2 * RAYS)


def test_subsets_are_rows_devices_agree_with_the_host_and_bricks_are_refused(rt, monkeypatch) -> None:
    operator, x, y = warped(rt, deformation(0.1), tables()), noise(GRID.shape), noise((2, *SHAPE))
    part = operator.subset([3, 1])
    np.testing.assert_array_equal(part.forward(x), operator.forward(x)[[3, 1]])
    again = part.subset([1])
    np.testing.assert_array_equal(again.forward(x), operator.forward(x)[[1]])
    np.testing.assert_array_equal(rt.download(part.forward(rt.upload(x))), part.forward(x))
    np.testing.assert_array_equal(rt.download(part.adjoint(rt.upload(y))), part.adjoint(y))
    monkeypatch.setattr(RayMemory, "plan", lambda self, share=1.0: [whole(GRID.shape)] * 2)
    with pytest.raises(OutOfMemoryError, match="2 bricks"):
        operator.forward(x)


def test_a_rigid_field_is_a_moved_scanner(rt) -> None:
    """Of whole voxels: the object at y is what the reference has at y + w, as a scanner sees it that is w further."""
    shift_mm = np.array([3 * 0.1, -0.25, 2 * 0.2])  # x, y, z
    control_mm = np.broadcast_to(shift_mm, (1, 11, 11, 11, 3))
    one = Deformation(control_mm, (-2.5,) * 3, 0.5, np.zeros(1), np.ones((1, 1)))
    inner = np.zeros(GRID.shape, np.float32)
    inner[3:-3, 2:-2, 4:-4] = noise(GRID.shape)[3:-3, 2:-2, 4:-4]
    cells = [static_cells(CircularOrbit(GEOMETRY, ConstantSpeed(0.3, 1.0)), Shutter(0.8, 0.6), 0, 0.5, SHAPE[0])]
    moved_pose = cells[0].pose + np.concatenate([shift_mm, shift_mm, np.zeros(6)])
    expected = RayOperator(rt, GRID, SHAPE, [replace(cells[0], pose=moved_pose)]).forward(inner)
    assert_near(warped(rt, one, cells).forward(inner), expected, 2 * RAYS)


def test_intensity_follows_the_object(rt) -> None:
    """With one cell per line both detector models are the same; with several the softmax weights sum to 1."""
    cells, x = tables(), noise(GRID.shape) * np.float32(0.1)
    one = deformation(0.1)
    projector = projector_of(rt, GRID, cells, one)
    mean = projector(rt, GRID, SHAPE, cells).forward(x)
    intensity = IntensityOperator(rt, GRID, SHAPE, cells, projector)
    assert_near(intensity.forward(x), mean, 2 * RAYS)  # at a volume of zeros
    expected = intensity.expected(x)
    assert np.all(expected <= mean + RAYS * mean.max()) and np.abs(expected - mean).max() > 1e-4 * mean.max()


def test_backprojection_follows_matter(rt) -> None:
    """From one pose per frame and per line; a state alone has the backprojection of the object where it then is."""
    states = states_of(deformation(0.05))
    times_s = np.array([0.0, 1.1, 2.3])
    shares = states.shares(times_s)
    frames, weight = noise((3, *SHAPE)), np.array([0.5, 0.8, 1.0])
    pose = GEOMETRY.pose(np.array([0.0, 1.3, 2.9]))
    inverse_mm = [states.deformation.inverse_on_grid_mm(GRID, weights) for weights in states.weights]
    push_mm = np.tensordot(shares, inverse_mm, 1)
    moving = MovingBackprojector(rt, states, shares)
    expected = backprojection(frames, pose, weight, GRID, push_mm=push_mm)
    assert_near(moving(frames, pose, weight, GRID), expected, GRIDDED_FIELD)
    still = backprojection(frames, pose, weight, GRID)
    assert np.abs(expected - still).max() > 10 * GRIDDED_FIELD * np.abs(expected).max()
    lines = np.repeat(pose[:, None], SHAPE[0], axis=1)
    assert_near(moving(frames, lines, weight, GRID), expected, GRIDDED_FIELD)


def test_states_cover_the_motion(rt) -> None:
    """A field counts by how far it moves, and not by its unit."""
    states = states_of(deformation(0.3))
    shares = states.shares(TIMES_S)
    assert 2 < states.count <= MOST_STATES
    np.testing.assert_allclose(shares.sum(1), 1, atol=1e-12)
    assert (shares > 0).sum(1).max() == 2
    off = shares @ states.weights - states.deformation.weights_at(TIMES_S)
    assert np.sqrt(np.einsum("tr,rs,ts->t", off, states.metric, off)).max() < 1.0  # voxels
    nearest = MotionStates.of_times(states.deformation, GRID, TIMES_S, blends=False)
    off = nearest.shares(TIMES_S) @ nearest.weights - states.deformation.weights_at(TIMES_S)
    assert (nearest.shares(TIMES_S) > 0).sum() == len(TIMES_S)
    assert np.sqrt(np.einsum("tr,rs,ts->t", off, states.metric, off)).max() < 1.0
    one = states.deformation
    control_mm = one.control_mm * np.array([10.0, 0.1]).reshape(2, 1, 1, 1, 1)
    other = states_of(Deformation(control_mm, one.origin_mm, one.spacing_mm, TIMES_S, one.weights * [0.1, 10.0]))
    np.testing.assert_allclose(other.weights, states.weights * [0.1, 10.0], atol=1e-9)
    at_rest = deformation(0.0)  # has states to be moved from where they are asked for
    assert states_of(at_rest).count == 1
    states = MotionStates.of_times(at_rest, GRID, TIMES_S, least_voxels=1.0)
    assert states.count > 3
    np.testing.assert_allclose(states.shares(TIMES_S).sum(1), 1)


def test_scans_of_more_frames_have_more_states(rt) -> None:
    fast = deformation(3.0)
    counts = [MotionStates.of_times(fast, GRID, TIMES_S, blends=False, most=most).count for most in (2, 5)]
    assert counts == [2, 5]
    frames = np.linspace(0.0, TIMES_S[-1], 60)
    orbit, shutter = CircularOrbit(GEOMETRY, ConstantSpeed(0.3, 1.0)), Shutter(0.05, 0.05)
    cells = [static_cells(orbit, shutter, f, start_s, SHAPE[0]) for f, start_s in enumerate(frames)]
    make = projector_of(rt, GRID, cells, fast)
    assert make.keywords["warp"].states.count == MOST_STATES + 5


def test_cubic_warps_hardly_blur(rt) -> None:
    """By half a voxel and back: trilinear samples lose eight times as much of a blob of σ 1.2 voxels."""
    z, y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in GRID.shape), indexing="ij")
    blob = np.exp(-(x**2 + y**2 + z**2) / (2 * 1.2**2)).astype(np.float32)
    half = np.broadcast_to(np.array(GRID.voxel_size_mm[::-1]) / 2, (1, 9, 9, 9, 3))
    one = Deformation(half, (-3.0,) * 3, 0.75, np.array([0.0, 1.0]), np.array([[1.0], [-1.0]]))
    warp = VolumeWarp(rt, MotionStates.of_times(one, GRID, one.times_s))
    there = rt.download(warp.forward(0, warp.source(rt.upload(blob))))
    cubic = rt.download(warp.forward(1, warp.source(rt.upload(there))))
    trilinear = scipy.ndimage.shift(scipy.ndimage.shift(blob, -0.5, order=1), 0.5, order=1)
    errors = [np.abs(volume - blob).max() for volume in (trilinear, cubic)]
    assert errors[0] > 8 * errors[1], errors
    splines = deformed(blob, GRID, one, warp.states.weights[0])
    assert_near(np.maximum(there, 0), splines, FLOAT32)


def in_voxels(fields_mm: np.ndarray) -> np.ndarray:
    return fields_mm / GRID.voxel_size_mm[::-1]


def difference(volume: np.ndarray, displacement: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The change of the float64 warp for a change of the displacement, by central differences."""
    ahead, behind = (warp_forward(volume, displacement + sign * STEP * change) for sign in (1, -1))
    return (ahead - behind) / (2 * STEP)


@pytest.mark.parametrize("size", [0.0, 0.4, 30.0])  # voxels; at rest, far outside of the volume
def test_slopes_are_those_of_the_cubic_volume(size) -> None:
    rng, volume = np.random.default_rng(0), noise(GRID.shape)
    displacement, direction = rng.normal(scale=size, size=(*GRID.shape, 3)), rng.normal(size=(*GRID.shape, 3))
    along = (warp_slopes(volume, displacement) * direction).sum(-1)
    assert_near(along, difference(volume, displacement, direction), 1e-4)


@pytest.fixture(scope="module")
def operator(rt) -> WarpedOperator:
    return WarpedOperator(rt, GRID, SHAPE, tables(3), warp=VolumeWarp(rt, states_of(deformation(0.1))))


def projected(operator, changes: dict[int, np.ndarray]) -> np.ndarray:
    rt = operator.rt
    frames = rt.empty(operator.frames_shape)
    operator.project(lambda k: rt.upload(changes[k], np.float32), frames)
    return rt.download(frames)


def test_derivatives_are_differences_and_have_their_transpose(operator) -> None:
    volume, states = noise(GRID.shape), operator.warp.states
    derivative = FieldDerivative(operator, volume)
    change_mm = np.random.default_rng(3).normal(size=states.deformation.control_mm.shape)
    origin, spacing = states.deformation.origin_mm, states.deformation.spacing_mm
    changed = type(states.deformation)(change_mm, origin, spacing, np.zeros(1), np.ones((1, len(change_mm))))
    fields = np.stack([changed.on_grid_mm(GRID, unit) for unit in np.eye(len(change_mm))])
    at = {k: in_voxels(np.tensordot(states.weights[k], states.fields_mm, 1)) for k in operator.states}

    by_control = {k: difference(volume, at[k], in_voxels(np.tensordot(states.weights[k], fields, 1))) for k in at}
    assert_near(derivative.forward(change_mm), projected(operator, by_control), 2 * RAYS)
    for r, frames in enumerate(derivative.by_weights()):
        by_weight = {k: difference(volume, at[k], in_voxels(states.fields_mm[r])) for k in at}
        assert_near(frames, projected(operator, by_weight), 2 * RAYS)
    frames = noise(operator.frames_shape, 5) - np.float32(0.5)
    forward = derivative.forward(change_mm).astype(np.float64)
    size = np.linalg.norm(forward) * np.linalg.norm(frames)
    assert abs(np.vdot(forward, frames) - np.vdot(change_mm, derivative.adjoint(frames))) <= ADJOINT * size
