"""FDK of helices and other orbits with travel: every voxel counts the views that see it."""

import numpy as np
import pytest
from balls import balls, frames_of, levels
from tolerances import FDK_ENDS, FDK_PARTIAL

from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Scan
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.fdk import FdkOptions, fdk, fdk_volume

GRID = Grid((8, 26, 26), (0.06,) * 3)
PHANTOM = balls(((0.4, 0, 0.05), 0.25), ((-0.3, 0.35, -0.05), 0.2), ((-0.2, -0.4, 0), 0.22), ((0, 0, 0), 0.2))
SHAPE = (16, 60)


def poses_of(angle_rad: np.ndarray, height_mm: np.ndarray, is_parallel: bool = False, offset_mm: float = 0.0) -> np.ndarray:
    """Poses (..., 12) lifted by heights (...); the panel is 0.64 mm high at the axis."""
    if is_parallel:
        pose = ParallelGeometry(SHAPE, 0.04, (0.0, offset_mm)).pose(angle_rad)
    else:
        pose = ConeGeometry(10.0, 15.0, SHAPE, 0.06, (0.0, 1.5 * offset_mm)).pose(angle_rad)
    pose[..., [5] if is_parallel else [2, 5]] += height_mm[..., None]
    return pose


def helix(turns: float, feed_mm: float, lines: int = 0, turned_rad: float = 0.1, **more) -> np.ndarray:
    angle = np.arange(round(60 * turns)) * 2 * np.pi / 60
    if lines:
        angle = angle[:, None] + turned_rad * (np.arange(lines) / lines - 0.5)
    return poses_of(angle, feed_mm * (angle / (2 * np.pi) - turns / 2), **more)


def reconstructed(rt, pose: np.ndarray, axis: str = "rows", is_parallel: bool = False) -> np.ndarray:
    frames = frames_of(PHANTOM, pose, SHAPE, axis, is_parallel)
    return levels(PHANTOM, fdk_volume(rt, frames, pose, GRID, axis=axis, is_parallel=is_parallel), GRID)


ANGLE = np.arange(180) * 2 * np.pi / 180
ORBITS = {
    "one turn": helix(1, 0.2), "less than a turn": helix(0.8, 0.1), "two turns": helix(2, 0.4),
    "six turns, downwards": helix(6, -0.4), "not whole turns": helix(3.4, 0.4), "a high pitch": helix(4, 0.75),
    "swings up and down": poses_of(ANGLE, 0.08 * np.sin(2 * ANGLE)),
}  # fmt: skip


@pytest.mark.parametrize("is_parallel", [False, True])
@pytest.mark.parametrize("offset_mm", [0.0, 0.4])
def test_densities_of_a_circle(rt, is_parallel, offset_mm, caplog) -> None:
    """Every view counted as if it saw every voxel: two turns had two thirds of the density, six a fifth. Each side of a
    panel off centre by a sixth is measured once by views half a turn apart."""
    more = {"is_parallel": is_parallel, "offset_mm": offset_mm}
    circle = reconstructed(rt, poses_of(ANGLE[::3], 0 * ANGLE[::3], **more), is_parallel=is_parallel)
    others = {"displaced": helix(4, 0.25, **more)} if offset_mm else {"parallel": helix(3, 0.4, **more)}
    for name, pose in (others if is_parallel or offset_mm else ORBITS).items():
        found = reconstructed(rt, pose, is_parallel=is_parallel)
        np.testing.assert_allclose(found, circle, atol=FDK_PARTIAL, err_msg=name)
    assert not caplog.records


@pytest.mark.slow
@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_with_a_pose_for_every_line(rt, axis) -> None:
    circle = reconstructed(rt, poses_of(ANGLE[::3], 0 * ANGLE[::3]))
    pose = helix(3, 0.4, SHAPE[axis == "columns"])
    np.testing.assert_allclose(reconstructed(rt, pose, axis), circle, atol=FDK_PARTIAL)


# balls at the ends of what a panel of SHAPE sees: 0.32 mm from the middle at the axis, where its outermost row ends
AT_ENDS = balls(((0.3, 0, 0.3), 0.22), ((-0.25, 0.3, -0.3), 0.22), ((-0.2, -0.3, 0.3), 0.2))
TALL, THIN = (48, SHAPE[1]), Grid((33, 26, 26), (0.02, 0.06, 0.06))  # a panel that sees all, and its slices


@pytest.mark.parametrize("axis", ["still", "rows", "columns"])
@pytest.mark.parametrize("is_parallel", [False, True])
def test_voxels_at_the_ends_have_the_mean_of_the_views_that_see_them(rt, axis, is_parallel) -> None:
    """They had half their density or none, and a single row reached only the slice in its own plane."""
    lines = {"still": 0, "rows": TALL[0], "columns": TALL[1]}[axis]
    along = "rows" if axis == "still" else axis
    pose = helix(1, 0.0, lines, 0.02, is_parallel=is_parallel)
    pose[..., 3:6] -= (TALL[0] - SHAPE[0]) / 2 * pose[..., 9:12]
    frames = frames_of(AT_ENDS, pose, TALL, along, is_parallel)

    def volume(rows: slice) -> np.ndarray:
        part = pose[:, rows] if axis == "rows" else pose
        moved = part.copy()
        moved[..., 3:6] += rows.start * part[..., 9:12]
        return fdk_volume(rt, frames[:, rows], moved, THIN, axis=along, is_parallel=is_parallel)

    whole, (z, y, x) = volume(slice(0, 48)), np.meshgrid(*THIN.axes_mm(), indexing="ij")
    for rows, middle_mm in ((slice(16, 32), 0.31), (slice(31, 32), 0.3)):  # the two slices, and the three, at their edges
        at = (np.hypot(y, x) < 0.6) & (np.abs(z - middle_mm) < 0.021)
        found, expected = volume(rows)[at], whole[at]
        assert np.linalg.norm(found - expected) < FDK_ENDS * np.linalg.norm(expected)


@pytest.mark.parametrize("by_lines", [False, True])
@pytest.mark.parametrize("geometry", [ParallelGeometry((1, 30), 0.05), ConeGeometry(10.0, 15.0, (1, 30), 0.075)])
def test_rounding_does_not_hide_the_slice_of_a_single_row(rt, geometry, by_lines) -> None:
    """It was 0, or a fifth as dense, where the panel was higher by 1e-12 mm in some views, or slices had 20 rows."""
    row = np.sqrt(np.maximum(16 - (np.arange(30) - 14.5) ** 2, 0))
    frames, angle, volumes = np.tile(row.astype(np.float32), (40, 1, 1)), np.arange(40) * 2 * np.pi / 40, []
    for away_mm, slice_mm in ((0.0, 0.05), (1e-12, 0.05), (9e-5, 1.0)):
        pose = geometry.pose(angle)
        pose[:, 5] += away_mm * np.random.default_rng(0).uniform(-1, 1, 40)
        pose = np.repeat(pose[:, None], 1, 1) if by_lines else pose
        parallel = isinstance(geometry, ParallelGeometry)
        volumes.append(fdk_volume(rt, frames, pose, Grid((1, 24, 24), (slice_mm, 0.05, 0.05)), is_parallel=parallel))
    np.testing.assert_allclose(volumes[1:], volumes[:1] * 2, atol=1e-3 * volumes[0].max())


def test_a_feed_that_leaves_voxels_with_less_than_half_a_turn_and_few_views_a_turn_are_named(rt, caplog) -> None:
    """Seven views a turn, also where no two turns have the same angles."""
    reconstructed(rt, helix(5, 2.0))
    assert "of the voxels are seen from less than half a turn, the least from" in caplog.records[0].message
    for views, is_said in ((7, True), (7.3, True), (25, False), (25.3, False)):
        angle = np.arange(3 * int(views)) * 2 * np.pi / views
        caplog.clear()
        reconstructed(rt, poses_of(angle, 0.4 * (angle - angle.mean()) / (2 * np.pi)))
        assert [line.startswith("FDK: 7 views a turn are few") for line in caplog.messages] == [True] * is_said


@pytest.mark.slow
def test_long_helices_are_not_refused(rt) -> None:
    """A travel of the source–panel distance: refused as far off a circle, of which a voxel only misses views."""
    scan = Scan.from_poses(frames_of(PHANTOM, pose := helix(20, 0.6), SHAPE), pose, GRID)
    assert abs(levels(PHANTOM, fdk(scan, FdkOptions(), rt).volume, GRID).mean() - 1) < FDK_PARTIAL
