"""What tests of kernels share: a frame's cells, splats of it and their gradients, the kernels launched, how near is near."""

from collections.abc import Callable

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Shutter
from phyradgs_cl.acquisition.cells import (
    centre_cells,
    exact_cells,
    micro_view_cells,
    per_line_cells,
    static_cells,
)
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields.gaussians import DENSITY, MEAN, QUATERNION, SCALE
from phyradgs_cl.operators import DeviceCells, SplatProjector
from phyradgs_cl.runtime import Runtime, context

CLASSES = {"mean": MEAN, "scale": SCALE, "quaternion": QUATERNION, "density": DENSITY}
MODELS = pytest.mark.parametrize("affine", [False, True], ids=["exact", "affine"])
READOUTS = [("rows", 1), ("rows", -1), ("columns", 1), ("columns", -1)]
CELLS = {
    "static": (static_cells, ()), "micro-views": (micro_view_cells, (4, 3)), "exact": (exact_cells, (4,)),
    "centres": (centre_cells, (4, 3)), "per-row": (per_line_cells, (3,)),
}  # fmt: skip
ROLLING = Shutter(0.8, 0.6)
CPU_ONLY = {
    "backproject_leaning", "backproject_upright", "bin_count", "bin_fill", "bin_starts", "bin_within", "rays_upright",
    "rays_upright_adjoint", "splat_backward_rows", "splat_forward_rows", "turn_upright", "merge_slots", "split_slots",
    "warp_adjoint_rows",
}  # fmt: skip


def frame_cells(
    motion: str, geometry: ConeGeometry, *counts: int, shutter: Shutter = ROLLING, speed: float = 0.5
) -> TimeCells:
    """The cells of a frame that begins at 0.2 s on a gantry of so many rad/s; ``counts`` in place of those of ``CELLS``."""
    make, usual = CELLS[motion]
    orbit = CircularOrbit(geometry, ConstantSpeed(0.3, speed))
    return make(orbit, shutter, 0, 0.2, shutter.lines(geometry.detector_shape), *(counts or usual))


def splat(rt: Runtime, rows: np.ndarray, table: TimeCells, shape: tuple[int, int], **options: object) -> np.ndarray:
    """The frame (rows, columns) of Gaussians (11, G), lines along the table's axis."""
    frame = SplatProjector(rt, *table.readout.shape(shape), **options)
    return table.readout.frames(frame.project(rows, DeviceCells.upload(rt, table)))


def splat_gradients(rt: Runtime, rows: np.ndarray, table: TimeCells, h: np.ndarray, **options: object) -> np.ndarray:
    """(11, G) of L = Σ h · frame, with h (rows, columns)."""
    image = table.readout.frames(h)
    return SplatProjector(rt, *image.shape, **options).project_adjoint(
        rows, DeviceCells.upload(rt, table), image.astype(np.float32)
    )


def random_weights(shape: tuple[int, ...]) -> np.ndarray:
    """Of either sign, in float32's numbers."""
    return np.random.default_rng(5).normal(size=shape).astype(np.float32).astype(np.float64)


def by_gaussian(
    finite_differences: Callable[..., np.ndarray], loss: Callable[[np.ndarray], float], rows: np.ndarray
) -> np.ndarray:
    """Differences (11, G) of ``loss`` of one Gaussian (11, 1) at a time: frames are sums, the others do not matter."""
    return np.stack([finite_differences(lambda r: float(loss(r[:, None])), row) for row in rows.T], -1)


def note_launches(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the kernels that are launched from now on."""
    names: list[str] = []
    launch = Runtime.launch

    def noted(self: Runtime, kernel: object, *args: object, **options: object) -> None:
        names.append(kernel.function_name)  # type: ignore[attr-defined]
        launch(self, kernel, *args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Runtime, "launch", noted)
    return names


def assert_near(found: np.ndarray, expected: np.ndarray, share: float, of: float | None = None) -> None:
    """No number is off by more than ``share`` of the largest expected, or of ``of``."""
    largest = np.abs(expected).max() if of is None else of
    np.testing.assert_allclose(found, expected, rtol=0, atol=share * largest)


def assert_between(found: np.ndarray, low: np.ndarray, high: np.ndarray, slack: float) -> None:
    """Between what two cutoffs leave, and zero where the wider one leaves nothing."""
    assert np.all(found >= low - slack) and np.all(found <= high + slack)
    np.testing.assert_array_equal(found[high == 0], 0)


def assert_classes(found: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    """Each class of parameters by itself: the norm of the difference over the norm."""
    for name, part in CLASSES.items():
        error = np.linalg.norm(found[part] - expected[part]) / np.linalg.norm(expected[part])
        assert error <= tolerance, (name, error)


def launches(monkeypatch) -> list[tuple[str, tuple, tuple, tuple | None]]:
    """(kernel, work-items, group, first item) of every launch from now on."""
    seen, launch = [], context.cl.enqueue_nd_range_kernel

    def noted(queue, kernel, items, group, first=None):
        seen.append((kernel.function_name, items, group, first))
        return launch(queue, kernel, items, group, first)

    monkeypatch.setattr(context.cl, "enqueue_nd_range_kernel", noted)
    return seen
