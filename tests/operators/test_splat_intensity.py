"""Splats on a detector that adds photons: −ln Σ w exp(−p) over a line's cells, against twins and differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from remembered import remembered
from tolerances import FINITE_DIFFERENCE_STEP, GRADIENT, INTENSITY_FRAME, SPLAT_CLOUD

from phyradgs_cl.acquisition import CircularOrbit, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import (
    TimeCells,
    exact_cells,
    micro_view_cells,
    per_line_cells,
    static_cells,
)
from phyradgs_cl.detector import average
from phyradgs_cl.operators import DeviceCells, SplatProjector
from phyradgs_cl.operators.twins.splat import splat_frame
from phyradgs_cl.operators.twins.splat_moving import moving_frame
from phyradgs_cl.runtime import Runtime

SHAPE = (13, 18)
UNIT = 2.5  # line integrals up to 6
MOTIONS = pytest.mark.parametrize("motion", ["static", "micro-views", "exact", "per-row"])
READOUTS = pytest.mark.parametrize(("axis", "direction"), [("rows", 1), ("columns", -1)])
MakeTable = Callable[[str, str, int], TimeCells]


@pytest.fixture
def make_table(make_geometry) -> MakeTable:
    orbit = CircularOrbit(make_geometry(*SHAPE, offset=(0.15, -0.25)), ConstantSpeed(0.3, 0.9))

    def make(motion: str, axis: str = "rows", direction: int = 1) -> TimeCells:
        shutter = Shutter(0.8, 0.6, axis, direction)
        where = (orbit, shutter, 0, 0.2, shutter.lines(SHAPE))
        if motion == "static":
            return static_cells(*where)
        if motion == "micro-views":
            return micro_view_cells(*where, 4, 3)
        return exact_cells(*where, 4) if motion == "exact" else per_line_cells(*where, 3)

    return make


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
        images.append(image if table.axis == "rows" else image.T)
        weights.append(one.line_weights())
    merged = [
        average(
            np.stack([unit * image[v] / w[v] for image, w in zip(images, weights, strict=True) if w[v] > 0]),
            [w[v] for w in weights if w[v] > 0],
            "intensity",
        )
        for v in range(table.lines)
    ]
    frame = np.stack(merged) / unit
    return frame if table.axis == "rows" else frame.T


def projector(rt: Runtime, table: TimeCells, **options: object) -> SplatProjector:
    lines, width = SHAPE if table.axis == "rows" else SHAPE[::-1]
    return SplatProjector(
        rt, lines, width, cutoff_sigma=0.0, time_error=1e-6, **{"intensity_unit": UNIT, **options}
    )


@MOTIONS
@READOUTS
def test_every_build_is_the_twin(any_rt, make_cloud, make_table, motion, axis, direction) -> None:
    rows, table = make_cloud(5, 61, scale=(0.05, 0.2)), make_table(motion, axis, direction)
    found = projector(any_rt, table).project(rows, DeviceCells.upload(any_rt, table))
    expected = twin(rows, table)
    found = found if axis == "rows" else found.T
    np.testing.assert_allclose(found, expected, rtol=0, atol=INTENSITY_FRAME * expected.max())
    mean = projector(any_rt, table, intensity_unit=None).project(rows, DeviceCells.upload(any_rt, table))
    gap = (mean if axis == "rows" else mean.T) - expected
    assert gap.min() > -1e-5  # Jensen: the mean of line integrals is never below
    assert (gap.max() > 0.02) == (motion != "static")


@MOTIONS
@pytest.mark.parametrize("affine", [False, True], ids=["exact", "affine"])
def test_gradients(any_rt, make_cloud, make_table, finite_differences, motion, affine) -> None:
    """Shares depend on all Gaussians together, so that differences are taken of the whole cloud."""
    rows, table = make_cloud(2, 62, scale=(0.08, 0.3)), make_table(motion)
    h = np.random.default_rng(5).normal(size=SHAPE).astype(np.float32).astype(np.float64)
    found = projector(any_rt, table, affine=affine).project_adjoint(
        rows, DeviceCells.upload(any_rt, table), h.astype(np.float32)
    )
    expected = finite_differences(
        lambda r: float((h * twin(r, table, affine=affine)).sum()), rows, FINITE_DIFFERENCE_STEP
    )
    for part in (slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 11)):
        wrong = np.linalg.norm(found[part] - expected[part])
        assert wrong <= GRADIENT * np.linalg.norm(expected[part])


def test_thin_objects_are_the_mean_of_line_integrals(rt, make_cloud, make_table) -> None:
    rows, table = make_cloud(4, 63), make_table("micro-views")
    cells = DeviceCells.upload(rt, table)
    mean = projector(rt, table, intensity_unit=None).project(rows, cells)
    thin = projector(rt, table, intensity_unit=1e-4).project(rows, cells)
    np.testing.assert_allclose(thin, mean, rtol=0, atol=2e-3 * mean.max())


def test_opaque_objects_do_not_overflow(rt, make_cloud, make_table) -> None:
    rows, table = make_cloud(4, 64), make_table("exact")
    cells = DeviceCells.upload(rt, table)
    opaque = projector(rt, table, intensity_unit=1e4)
    frame = opaque.project(rows, cells)
    np.testing.assert_allclose(frame, twin(rows, table, 1e4), rtol=0, atol=SPLAT_CLOUD * frame.max())
    assert np.isfinite(opaque.project_adjoint(rows, cells, np.ones(SHAPE, np.float32))).all()


def test_nothing_drawn_is_nothing_seen(any_rt, make_table) -> None:
    table = make_table("micro-views")
    frame = projector(any_rt, table).project(np.zeros((11, 0)), DeviceCells.upload(any_rt, table))
    np.testing.assert_array_equal(frame, 0)


@MOTIONS
def test_no_line_has_two_cells_in_a_layer(make_table, motion) -> None:
    table = make_table(motion)
    weights = table.layer_weights
    np.testing.assert_allclose(weights.sum(axis=0), 1, rtol=0, atol=1e-12)
    busiest = max(
        sum(a <= v < b for a, b in zip(table.line_start, table.line_stop, strict=True))
        for v in range(table.lines)
    )
    assert len(weights) == busiest


def test_launches_do_not_grow_with_the_cells(rt, make_cloud, make_table, monkeypatch) -> None:
    names: list[str] = []
    launch = Runtime.launch

    def counting(self, kernel, *args, **options):
        names.append(kernel.function_name)
        launch(self, kernel, *args, **options)

    monkeypatch.setattr(Runtime, "launch", counting)
    table = make_table("exact")
    projector(rt, table).project(make_cloud(4, 65), DeviceCells.upload(rt, table))
    assert names.count("splat_forward_rows") == 1 and names.count("intensity_merge") == 1
