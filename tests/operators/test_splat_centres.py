"""Splats of which only the centres move: against their float64 twin, and between a static frame and micro-views."""

from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import (
    assert_classes,
    assert_near,
    by_gaussian,
    frame_cells,
    random_weights,
    splat,
    splat_gradients,
)
from tolerances import GRADIENT, SPLAT_MOVING

from phyradgs_cl.acquisition import Shutter
from phyradgs_cl.errors import InputError
from phyradgs_cl.operators.twins.splat import moving_frame

pytestmark = pytest.mark.slow

SHAPE = (13, 18)


@pytest.mark.parametrize(("readout", "affine"), [(("rows", 1), False), (("columns", -1), False), (("rows", -1), True)])
def test_frames_and_gradients_are_those_of_the_twin(two_rt, make_cloud, make_geometry, finite_differences, readout, affine):
    """A cutoff at six sigmas leaves gradients as they are."""
    shutter = Shutter(0.8, 0.6, *readout)
    table = frame_cells("centres", make_geometry(*SHAPE, offset=(0.15, -0.25)), 3, 2, shutter=shutter)
    rows, h, options = make_cloud(2, 21, scale=(0.05, 0.3)), random_weights(SHAPE), {"affine": affine, "cutoff_sigma": 0.0}
    assert_near(splat(two_rt, rows, table, SHAPE, **options), moving_frame(rows, table, SHAPE, affine=affine), SPLAT_MOVING)
    expected = by_gaussian(finite_differences, lambda r: (h * moving_frame(r, table, SHAPE, affine=affine)).sum(), rows)
    whole = splat_gradients(two_rt, rows, table, h, **options)
    assert_classes(whole, expected, GRADIENT)
    assert_classes(splat_gradients(two_rt, rows, table, h, affine=affine, cutoff_sigma=6.0), whole, 1e-4)


def test_only_the_centre_follows_the_gantry(rt, make_cloud, make_geometry) -> None:
    """A round Gaussian on the axis looks alike from everywhere: nothing is lost. A long one is wrong, more than by poses."""
    geometry, (round_one, long_one) = make_geometry(*SHAPE), (make_cloud(1, 23) for _ in range(2))
    for rows, scale in ((round_one, 0.2), (long_one, [[0.5], [0.1], [0.1]])):
        rows[:3], rows[3:6], rows[6:10] = 0.0, scale, [[1.0], [0.0], [0.0], [0.0]]
    tables = [frame_cells(motion, geometry, speed=0.8) for motion in ("centres", "micro-views", "static")]
    assert_near(*(splat(rt, round_one, table, SHAPE) for table in tables[:2]), SPLAT_MOVING)
    moved, right, still = (splat(rt, long_one, table, SHAPE) for table in tables)
    assert_near(moved, still, SPLAT_MOVING)  # the centre does not move on the panel
    assert np.abs(moved - right).max() > 0.01 * right.max()


def test_a_gantry_at_rest_gives_a_static_frame(rt, make_cloud, make_geometry) -> None:
    still = frame_cells("static", make_geometry(*SHAPE), speed=0.0)
    moved, rows = frame_cells("centres", make_geometry(*SHAPE), speed=0.0), make_cloud(3, 24)
    assert_near(splat(rt, rows, moved, SHAPE), splat(rt, rows, still, SHAPE), SPLAT_MOVING)
    table = frame_cells("centres", make_geometry(*SHAPE), 2, 2)
    np.testing.assert_array_equal(table.scaled(50.0).conic_pose, 50.0 * table.conic_pose)
    with pytest.raises(InputError, match="conic pose"):
        table.still()
    assert replace(table, conic_pose=None).still().count == 4
