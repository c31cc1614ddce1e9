"""One iteration of the real loop against finite differences of the whole objective in float64: raw numbers → activation →
splats through time cells → L1 + weighed squares + SSIM, + total variation of a crop, + parameter terms."""

from dataclasses import replace

import numpy as np
import pytest
from kernel_kit import assert_classes
from tolerances import FINITE_DIFFERENCE_STEP, WHOLE_GRADIENT, WHOLE_VALUE

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, MicroViews, Scan, Shutter
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields import Grid
from phyradgs_cl.fields.gaussians import MEAN
from phyradgs_cl.objective.terms import image_loss, mean_density, total_variation
from phyradgs_cl.operators.twins.splat import splat_frame, voxel_field
from phyradgs_cl.optim import DensityControl, Population
from phyradgs_cl.reconstructors.splats.method import SplatRun
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.reconstructors.splats.step import Scale

SHAPE, COUNT, SEED = (13, 15), 5, 17
UNIT = Scale(length_mm=20.0, density_per_mm=0.05)
GRID = Grid((7, 9, 10), (4.0, 4.2, 4.0), (1.0, 0.0, -1.0))  # half the longest side is 20 mm
OPTIONS = SplatOptions(
    motion=MicroViews(3, 2), iterations=1, ssim_weight=0.25, l1_weight=0.7, tv_weight=0.3,
    tv_edge=6, density_weight=0.02, parameter_terms_from=0, cutoff_sigma=0.0, scale_max=0.6, control=DensityControl(every=0),
)  # fmt: skip


def internal(table: TimeCells) -> TimeCells:
    return replace(table, pose=table.pose / UNIT.length_mm)


def make_scan(axis: str, rows: np.ndarray) -> Scan:
    """Three frames that miss what the cloud would show by 0.05 to 0.3 everywhere (L1 has a kink), some masked."""
    geometry = ConeGeometry(100.0, 150.0, SHAPE, (78.0 / 13, 82.0 / 15), (2.0, -3.0))
    orbit = CircularOrbit(geometry, ConstantSpeed(0.4, 0.5))
    rng = np.random.default_rng(4)
    mask = (rng.uniform(size=SHAPE) < 0.15).astype(np.uint8)
    empty = np.zeros((3, *SHAPE), np.float32)
    scan = Scan(empty, geometry, orbit, Shutter(0.4, 0.3, axis, -1), np.array([0.0, 2.0, 5.0]), GRID, pixel_mask=mask)
    frames = np.stack([splat_frame(rows, internal(OPTIONS.motion.cells(scan, f)), SHAPE) for f in range(3)])
    frames += rng.choice([-1, 1], frames.shape) * rng.uniform(0.05, 0.3, frames.shape)
    return replace(scan, projections=(frames * UNIT.line_integral).astype(np.float32))


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_gradient_of_everything(rt, make_cloud, finite_differences, axis) -> None:
    grid = GRID.scaled(1 / UNIT.length_mm)
    activation = OPTIONS.activation(grid)
    raw = activation.invert(make_cloud(COUNT, 101, scale=(0.08, 0.35)))
    raw[6:10] *= 1.3
    raw = raw.astype(np.float32).astype(float)
    scan = make_scan(axis, activation.apply(raw))

    rng = np.random.default_rng(SEED)  # draws as the loop does: the frame, then the corner of the crop
    frame = int(rng.permutation(3)[-1])
    start = [int(rng.integers(n - 6 + 1)) for n in GRID.shape]
    crop = grid.part((start[0], start[1], start[2]), (6, 6, 6))
    table = internal(OPTIONS.motion.cells(scan, frame))
    measured = scan.projections[frame].astype(float) / UNIT.line_integral
    mask = (scan.pixel_mask == 0).astype(float)

    def image_term(at: np.ndarray) -> float:
        rendered = splat_frame(activation.apply(at), table, SHAPE)
        return image_loss(rendered, measured, mask, OPTIONS.ssim_weight, OPTIONS.l1_weight)[0]

    def objective(at: np.ndarray) -> float:
        rows = activation.apply(at)
        variation = total_variation(voxel_field(rows, *crop.axes_mm()))[0]
        return image_term(at) + OPTIONS.tv_weight * variation + mean_density(rows, OPTIONS.density_weight)[0]

    population = Population(raw, np.zeros((2, *raw.shape)))
    run = SplatRun(rt, scan, OPTIONS, UNIT, population, np.random.default_rng(SEED))
    run.step()
    assert run.measures()["loss"] == pytest.approx(image_term(raw), rel=WHOLE_VALUE)
    found = rt.download(run.cloud.gradients)[:11, :COUNT]
    expected = finite_differences(objective, raw, FINITE_DIFFERENCE_STEP)
    assert_classes(found, expected, WHOLE_GRADIENT)
    moved = rt.download(run.cloud.raw)[:, :COUNT] - raw
    np.testing.assert_array_equal(np.sign(moved[MEAN]), -np.sign(expected[MEAN]))  # and it goes downhill
