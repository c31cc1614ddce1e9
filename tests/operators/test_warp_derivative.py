"""The derivatives of a moving object's frames by its field: against differences of the float64 warp, and transposed."""

import numpy as np
import pytest
from kernel_kit import assert_near
from ray_tables import noise
from tolerances import ADJOINT, RAYS

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import common_time_cells
from phyradgs_cl.fields import Deformation, Grid, control_points
from phyradgs_cl.operators.twins.rays import warp_forward
from phyradgs_cl.operators.warp.operator import FieldDerivative, WarpedOperator, warp_slopes
from phyradgs_cl.operators.warp.states import MotionStates
from phyradgs_cl.operators.warp.volume import VolumeWarp

GRID = Grid((9, 7, 12), (0.2, 0.25, 0.15), (0.1, -0.05, 0.0))
TIMES_S = np.linspace(0.0, 4.0, 13)
_STEP = 1e-5  # voxels, or of a unit of weight


def deformation(size_mm: float) -> Deformation:
    """A smooth random field of rank 2."""
    origin_mm, counts = control_points(GRID, 0.6)
    control_mm = np.random.default_rng(0).normal(scale=size_mm, size=(2, *counts, 3))
    weights = np.stack([np.cos(TIMES_S), np.sin(TIMES_S)], -1)
    return Deformation(control_mm, origin_mm, 0.6, TIMES_S, weights)


def in_voxels(fields_mm: np.ndarray) -> np.ndarray:
    return fields_mm / GRID.voxel_size_mm[::-1]


def difference(volume: np.ndarray, displacement: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The change of the float64 warp for a change of the displacement, by central differences."""
    ahead, behind = (warp_forward(volume, displacement + sign * _STEP * change) for sign in (1, -1))
    return (ahead - behind) / (2 * _STEP)


@pytest.mark.parametrize("size", [0.0, 0.4, 30.0])  # voxels; at rest, far outside of the volume
def test_slopes_are_those_of_the_cubic_volume(size) -> None:
    rng, volume = np.random.default_rng(0), noise(GRID.shape)
    displacement, direction = rng.normal(scale=size, size=(*GRID.shape, 3)), rng.normal(size=(*GRID.shape, 3))
    along = (warp_slopes(volume, displacement) * direction).sum(-1)
    assert_near(along, difference(volume, displacement, direction), 1e-4)


@pytest.fixture(scope="module")
def operator(rt):
    geometry = ConeGeometry(5.0, 7.5, (10, 12), (0.35, 0.3))
    orbit, shutter, start_s = CircularOrbit(geometry, ConstantSpeed(0.3, 1.0)), Shutter(0.8, 0.6), 1.2 * np.arange(3)
    tables = [common_time_cells(orbit, shutter, f, start_s, 10, 3) for f in range(3)]
    states = MotionStates.of_times(deformation(0.1), GRID, TIMES_S)
    return WarpedOperator(rt, GRID, (10, 12), tables, warp=VolumeWarp(rt, states))


def projected(operator, changes: dict[int, np.ndarray]) -> np.ndarray:
    rt = operator.rt
    frames = rt.empty(operator.frames_shape)
    operator.project(lambda k: rt.upload(changes[k], np.float32), frames)
    return rt.download(frames)


def test_derivatives_are_differences(operator) -> None:
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


def test_derivatives_have_their_transpose(operator) -> None:
    derivative = FieldDerivative(operator, noise(GRID.shape))
    change_mm = np.random.default_rng(4).normal(size=operator.warp.states.deformation.control_mm.shape)
    frames = noise(operator.frames_shape, 5) - np.float32(0.5)
    forward = derivative.forward(change_mm).astype(np.float64)
    size = np.linalg.norm(forward) * np.linalg.norm(frames)
    assert abs(np.vdot(forward, frames) - np.vdot(change_mm, derivative.adjoint(frames))) <= ADJOINT * size


def test_a_field_of_zeros_has_states_to_be_moved_from() -> None:
    at_rest = deformation(0.0)
    assert MotionStates.of_times(at_rest, GRID, at_rest.times_s).count == 1
    states = MotionStates.of_times(at_rest, GRID, at_rest.times_s, least_voxels=1.0)
    assert states.count > 3
    np.testing.assert_allclose(states.shares(at_rest.times_s).sum(1), 1)
