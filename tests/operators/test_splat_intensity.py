"""Splats on a detector that adds photons: −ln Σ w exp(−p) over a line's cells, against twins and differences."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import assert_classes, assert_near, frame_cells, random_weights
from remembered import remembered
from tolerances import GRADIENT, INTENSITY_FRAME, SPLAT_CLOUD

from phyradgs_cl.acquisition import Shutter
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.detector import average
from phyradgs_cl.operators import DeviceCells, SplatProjector
from phyradgs_cl.operators.twins.splat import moving_frame, splat_frame
from phyradgs_cl.runtime import Runtime

pytestmark = pytest.mark.slow

SHAPE = (13, 18)
UNIT = 2.5  # line integrals up to 6
COUNTS = {"static": (), "micro-views": (2, 2), "exact": (2,), "per-row": (2,)}
MakeTable = Callable[..., TimeCells]


@pytest.fixture
def make_table(make_geometry) -> MakeTable:
    geometry = make_geometry(*SHAPE, offset=(0.15, -0.25))
    return lambda motion, *way: frame_cells(motion, geometry, *COUNTS[motion], shutter=Shutter(0.8, 0.6, *way), speed=0.9)


@remembered
def twin(rows: np.ndarray, table: TimeCells, unit: float = UNIT, affine: bool = False) -> np.ndarray:
    """The merged frame (rows, columns): every cell by its own float64 twin, averaged line by line."""
    weights, images = [], []
    for cell in range(table.count):
        chosen = ("pose", "time_s", "line_start", "line_stop", "weight", "end_poses", "line_times")
        parts = {name: getattr(table, name) for name in chosen}
        one = replace(table, **{name: None if part is None else part[[cell]] for name, part in parts.items()})
        frame = moving_frame if table.end_poses is not None else splat_frame
        image = frame(rows, one, SHAPE, affine=affine)
        images.append(table.readout.frames(image))
        weights.append(one.line_weights())
    merged = [
        average(
            np.stack([unit * image[v] / w[v] for image, w in zip(images, weights, strict=True) if w[v] > 0]),
            [w[v] for w in weights if w[v] > 0], "intensity",
        )
        for v in range(table.lines)
    ]
    return table.readout.frames(np.stack(merged) / unit)


def projector(rt: Runtime, table: TimeCells, **options: object) -> SplatProjector:
    options = {"intensity_unit": UNIT, "cutoff_sigma": 0.0, "time_error": 1e-6, **options}
    return SplatProjector(rt, *table.readout.shape(SHAPE), **options)


@pytest.mark.parametrize(("motion", "axis", "direction"), [
    ("static", "rows", 1), ("micro-views", "columns", -1), ("exact", "rows", 1), ("exact", "columns", -1),
    ("per-row", "rows", 1),
])  # fmt: skip
def test_frames_are_the_twins(two_rt, make_cloud, make_table, motion, axis, direction) -> None:
    rows, table = make_cloud(5, 61, scale=(0.05, 0.2)), make_table(motion, axis, direction)
    cells, units = DeviceCells.upload(two_rt, table), ({}, {"intensity_unit": None})
    found, mean = (table.readout.frames(projector(two_rt, table, **unit).project(rows, cells)) for unit in units)
    expected = twin(rows, table)
    assert_near(found, expected, INTENSITY_FRAME)
    gap = mean - expected
    assert gap.min() > -1e-5  # Jensen: the mean of line integrals is never below
    assert (gap.max() > 0.02) == (motion != "static")


@pytest.mark.parametrize(("motion", "affine"), [
    ("static", False), ("micro-views", True), ("exact", False), ("exact", True), ("per-row", False),
])  # fmt: skip
def test_gradients(two_rt, make_cloud, make_table, finite_differences, motion, affine) -> None:
    """Shares depend on all Gaussians together, so that differences are taken of the whole cloud."""
    rows, table, h = make_cloud(2, 62, scale=(0.08, 0.3)), make_table(motion), random_weights(SHAPE)
    cells = DeviceCells.upload(two_rt, table)
    found = projector(two_rt, table, affine=affine).project_adjoint(rows, cells, h.astype(np.float32))
    expected = finite_differences(lambda r: float((h * twin(r, table, affine=affine)).sum()), rows)
    assert_classes(found, expected, GRADIENT)


def test_thin_and_opaque_objects_and_none(any_rt, make_cloud, make_table) -> None:
    """The mean of line integrals; no overflow; nothing seen where nothing is drawn."""
    table, rows = make_table("micro-views"), make_cloud(4, 63)
    cells = DeviceCells.upload(any_rt, table)
    mean, thin = (projector(any_rt, table, intensity_unit=unit).project(rows, cells) for unit in (None, 1e-4))
    assert_near(thin, mean, 2e-3)
    np.testing.assert_array_equal(projector(any_rt, table).project(np.zeros((11, 0)), cells), 0)
    table = make_table("exact")
    cells, opaque = DeviceCells.upload(any_rt, table), projector(any_rt, table, intensity_unit=1e4)
    frame = opaque.project(rows, cells)
    assert_near(frame, twin(rows, table, 1e4), SPLAT_CLOUD, frame.max())
    assert np.isfinite(opaque.project_adjoint(rows, cells, np.ones(SHAPE, np.float32))).all()
