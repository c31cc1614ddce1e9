"""The splat's adjoint against central differences of its float64 twin, a class of parameters at a time."""

import numpy as np
import pytest
from kernel_kit import MODELS, READOUTS, assert_classes, assert_near, by_gaussian, frame_cells, random_weights
from kernel_kit import splat as render
from tolerances import CUTOFF_EDGE_SIGMA, FLOAT64, GRADIENT

from phyradgs_cl.acquisition import Shutter
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.fields.gaussians import QUATERNION, SCALE
from phyradgs_cl.operators import DEFAULT_CUTOFF_SIGMA, DeviceCells, DeviceGaussians, SplatProjector
from phyradgs_cl.operators.splats.layout import projection_matrices
from phyradgs_cl.operators.twins.splat import precision_matrices, splat_frame
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.runtime.layout import pad_rows

SHAPE = (13, 18)


def device_gradients(rt, rows: np.ndarray, table: TimeCells, h: np.ndarray, **options: object) -> np.ndarray:
    """Rows (13, G) of dL/d… for L = Σ h · frame, with h (rows, columns)."""
    image = h if table.axis == "rows" else h.T
    projector = SplatProjector(rt, *image.shape, **options)
    cells, gaussians = DeviceCells.upload(rt, table), DeviceGaussians.upload(rt, rows)
    projector.forward(gaussians, cells)
    gradients = rt.zeros((13, gaussians.stride))
    projector.backward(gaussians, cells, rt.upload(pad_rows(image)), gradients)
    return rt.download(gradients)[:, : gaussians.count]


def expected_gradients(finite_differences, rows, table, h, affine: bool = False) -> np.ndarray:
    return by_gaussian(finite_differences, lambda r: (h * splat_frame(r, table, SHAPE, affine=affine)).sum(), rows)


@MODELS
@pytest.mark.parametrize(("motion", "readout"), [*zip(2 * ["static", "micro-views"], READOUTS, strict=True)], ids=str)
def test_every_class_of_parameters(any_rt, make_cloud, make_geometry, finite_differences, motion, readout, affine):
    """In every way to build the kernels."""
    table = frame_cells(motion, make_geometry(*SHAPE, offset=(0.15, -0.25)), shutter=Shutter(0.8, 0.6, *readout))
    rows, h = make_cloud(3, 21, scale=(0.05, 0.3)), random_weights(SHAPE)
    found = device_gradients(any_rt, rows, table, h, affine=affine, cutoff_sigma=0.0)
    assert_classes(found, expected_gradients(finite_differences, rows, table, h, affine), GRADIENT)


ROUNDING = 1 + 3e-6 * np.array([[1.0], [0.0], [-1.0]])  # what three equal steps of Adam may leave
ROUNDED = [("micro-views", {"affine": True}), ("exact", {})]


@pytest.mark.slow
@pytest.mark.parametrize(("motion", "options"), ROUNDED, ids=str)
def test_rounding_does_not_turn_a_round_gaussian(two_rt, make_cloud, make_geometry, motion, options) -> None:
    """Its torque is a difference that cancels; Adam would make whole steps of what rounding leaves of it."""
    rows, h = make_cloud(5, 22, scale=(0.05, 0.3)), random_weights(SHAPE)
    table = frame_cells(motion, make_geometry(*SHAPE))
    rows[SCALE] = rows[SCALE][:1] * ROUNDING
    found = device_gradients(two_rt, rows, table, h, **options)[:11]
    assert not found[QUATERNION].any() and found[SCALE].all()
    rows[SCALE] *= 1 + 1e-4 * np.array([[1.0], [0.0], [0.0]])
    assert device_gradients(two_rt, rows, table, h, **options)[QUATERNION].any()


def test_with_cutoff_only_drawn_pixels_pull(two_rt, make_cloud, make_geometry, finite_differences) -> None:
    """The set of drawn pixels is held fixed: the cutoff's edge itself has no gradient."""
    table, rows = frame_cells("static", make_geometry(*SHAPE)), make_cloud(4, 24, scale=(0.05, 0.25))
    h, expected = random_weights(SHAPE), np.zeros((11, 4))
    cutoffs = DEFAULT_CUTOFF_SIGMA - CUTOFF_EDGE_SIGMA, DEFAULT_CUTOFF_SIGMA + CUTOFF_EDGE_SIGMA
    masks = [[splat_frame(row[:, None], table, SHAPE, cutoff) > 0 for cutoff in cutoffs] for row in rows.T]
    h[np.any([low != high for low, high in masks], axis=0)] = 0.0  # float32 may disagree there
    for g, (drawn, _) in enumerate(masks):
        expected[:, g : g + 1] = expected_gradients(finite_differences, rows[:, g : g + 1], table, h * drawn)
        assert not drawn.all()
    assert_classes(device_gradients(two_rt, rows, table, h), expected, GRADIENT)


@pytest.mark.parametrize("motion", ["static", "exact"])
def test_what_is_not_drawn_has_no_gradient(two_rt, make_cloud, make_geometry, motion) -> None:
    table = frame_cells(motion, make_geometry(*SHAPE))
    rows = make_cloud(3, 25, scale=(0.05, 0.1))
    rows[:3, 1], rows[1, 2] = (9.0, 3.0, 0.2), 4.0  # behind the source at any time; off the detector
    frames = (render(two_rt, some, table, SHAPE) for some in (rows, rows[:, :1]))
    np.testing.assert_array_equal(*frames)
    found = device_gradients(two_rt, rows, table, random_weights(SHAPE))
    np.testing.assert_array_equal(found[:, 1:], 0)
    assert np.all(np.isfinite(found)) and np.any(found[:, 0])


WALKED = [("static", {}), ("micro-views", {"affine": True}), ("exact", {}), ("exact", {"cutoff_sigma": 0.0})]


@pytest.mark.parametrize(("motion", "options"), WALKED, ids=str)
def test_a_group_sums_what_one_item_sums(banded_rt, make_cloud, make_geometry, motion, options) -> None:
    """Lines are walked within the cutoff there and from side to side of a box here: thin, tilted, cut by the border."""
    rows, shape = make_cloud(40, 27, scale=(0.01, 0.5)), (40, 46)
    table, h = frame_cells(motion, make_geometry(*shape)), random_weights(shape)
    shapes = banded_rt, Runtime(lanes=1, pixel_items=True)
    one, group = (device_gradients(rt, rows, table, h, **options) for rt in shapes)
    assert_classes(group, one, GRADIENT)


def image_with_moved_centre(
    row: np.ndarray, pose: np.ndarray, shape: tuple[int, int], shift: np.ndarray
) -> np.ndarray:
    """The detector-space splat with its centre moved by ``shift`` (v, u) pixels and nothing else changed:
    p = |d| ρ √(2π/α) exp(−q/2) / √Q with Q = 1 + 2 b·Δ + ΔᵀCΔ and q = ΔᵀSΔ/Q (design notes, section 3).
    """
    precision = precision_matrices(row[:, None])[0]
    x, y, z = projection_matrices(pose[None]).reshape(3, 4) @ np.append(row[:3], 1.0)
    d0, steps = (row[:3] - pose[:3]) / z, np.stack([pose[6:9], pose[9:12]], -1)
    alpha = d0 @ precision @ d0
    b, c = steps.T @ precision @ d0 / alpha, steps.T @ precision @ steps / alpha
    s = z * z * alpha * (c - np.outer(b, b))
    v, u = np.mgrid[: shape[0], : shape[1]]
    delta = np.stack([u - x / z - shift[1], v - y / z - shift[0]], -1)
    big_q = 1 + 2 * delta @ b + np.einsum("...i,ij,...j", delta, c, delta)
    q = np.einsum("...i,ij,...j", delta, s, delta) / big_q
    ray = pose[3:6] - pose[:3] + u[..., None] * pose[6:9] + v[..., None] * pose[9:12]
    return np.linalg.norm(ray, axis=-1) * row[10] * np.sqrt(2 * np.pi / alpha / big_q) * np.exp(-q / 2)


@pytest.mark.parametrize("readout", READOUTS, ids=str)
@pytest.mark.parametrize("motion", ["static", "micro-views"])
def test_statistic_rows_are_the_gradient_by_the_seen_centre(
    rt, make_cloud, make_geometry, finite_differences, motion, readout
) -> None:
    """Rows 11 and 12: across the lines and along the readout, per half the detector's width."""
    table = frame_cells(motion, make_geometry(*SHAPE, offset=(0.15, -0.25)), shutter=Shutter(0.8, 0.6, *readout))
    rows, h = make_cloud(3, 26, scale=(0.05, 0.3)), random_weights(SHAPE)
    found = device_gradients(rt, rows, table, h, cutoff_sigma=0.0)[11:]

    def frame(row: np.ndarray, shift: np.ndarray) -> np.ndarray:
        total = np.zeros(SHAPE)
        for c in range(table.count):
            lines = slice(int(table.line_start[c]), int(table.line_stop[c]))
            image = table.weight[c] * image_with_moved_centre(row, table.pose[c], SHAPE, shift)
            table.readout.frames(total)[lines] += table.readout.frames(image)[lines]
        return total

    for g, row in enumerate(rows.T):
        assert_near(frame(row, np.zeros(2)), splat_frame(row[:, None], table, SHAPE), FLOAT64, rows[10, g])
        by_v, by_u = finite_differences(lambda shift, r=row: float((h * frame(r, shift)).sum()), np.zeros(2))
        by_v, by_u = by_v * SHAPE[0] / 2, by_u * SHAPE[1] / 2
        across, along = (by_u, by_v) if table.axis == "rows" else (by_v, by_u)
        assert np.linalg.norm(found[:, g] - (across, along)) <= GRADIENT * np.hypot(across, along)
