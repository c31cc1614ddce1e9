"""FDK with a pose for every line: scans that are read out while the gantry turns."""

from dataclasses import replace

import numpy as np
import pytest
from tolerances import FDK_LINES, FDK_PARTIAL, FLOAT32

from phyradgs_cl.acquisition import (
    CircularOrbit,
    ConeGeometry,
    FrameSweeps,
    LineMiddles,
    Scan,
    Shutter,
    Static,
)
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.reconstructors.fdk import FdkOptions, fdk, fdk_volume

VIEWS, PIXELS = 60, 48
GRID = Grid.cube(36, 2.0)
GEOMETRY = ConeGeometry(6.0, 9.0, (PIXELS, PIXELS), (0.08, 0.08))
BALLS = (((0.5, 0.1, 0.2), 0.25), ((-0.3, 0.5, -0.3), 0.3), ((0.0, -0.5, 0.4), 0.2), ((0.1, 0.0, 0.0), 0.15))
PHANTOM = EllipsoidPhantom(tuple(Ellipsoid(c, (r,) * 3, 1.0) for c, r in BALLS), "balls")


def line_frames(pose: np.ndarray, axis: str) -> np.ndarray:
    """Closed-form frames (F, rows, columns) of poses (F, lines, 12)."""
    one = pose[:, :, None] if axis == "rows" else pose[:, None]
    columns, rows = np.arange(PIXELS)[None, :, None], np.arange(PIXELS)[:, None, None]
    target = one[..., 3:6] + columns * one[..., 6:9] + rows * one[..., 9:12]
    return PHANTOM.line_integrals(np.broadcast_to(one[..., :3], target.shape), target).astype(np.float32)


def rolling_scan(axis: str, direction: int = 1, readout_deg: float = 18.0, arc_deg: float = 360.0) -> Scan:
    """A scan without exposure blur whose gantry turns ``readout_deg`` while a frame is read out."""
    start_s = np.arange(VIEWS) * 1.0
    first = np.deg2rad(arc_deg) * np.arange(VIEWS) / VIEWS
    exposure_s = 1e-6
    speed_rad_per_s = np.deg2rad(readout_deg) / 0.5
    sweeps = FrameSweeps(start_s, exposure_s, first, first + speed_rad_per_s * exposure_s)
    shutter = Shutter(exposure_s, 0.5, axis, direction)
    orbit = CircularOrbit(GEOMETRY, sweeps)
    delay_s = shutter.delay_s(PIXELS) + exposure_s / 2
    pose = np.stack([orbit.pose(f, start + delay_s) for f, start in enumerate(start_s)])
    return Scan(line_frames(pose, axis), GEOMETRY, orbit, shutter, start_s, GRID)


def error(volume: np.ndarray) -> float:
    """Root mean square deviation inside the field of view."""
    z, y, x = np.meshgrid(*GRID.axes_mm(), indexing="ij")
    seen = (np.hypot(x, y) < 0.95) & (np.abs(z) < 0.8)
    return float(np.sqrt(np.mean((volume - PHANTOM.voxelise(GRID))[seen] ** 2)))


@pytest.fixture(scope="module")
def error_at_rest(rt) -> float:
    pose = GEOMETRY.pose(2 * np.pi * np.arange(VIEWS) / VIEWS)
    return error(fdk_volume(rt, line_frames(np.repeat(pose[:, None], PIXELS, 1), "rows"), pose, GRID))


@pytest.mark.parametrize("axis", ["rows", "columns"])
@pytest.mark.parametrize("direction", [1, -1])
def test_per_row_undoes_the_readout(rt, error_at_rest, axis, direction) -> None:
    """As good as a gantry at rest, in either direction, where one pose per frame is clearly worse."""
    scan = rolling_scan(axis, direction)
    per_row = error(fdk(scan, FdkOptions(motion=LineMiddles()), rt).volume)
    static = error(fdk(scan, FdkOptions(motion=Static()), rt).volume)
    assert per_row <= FDK_LINES * error_at_rest
    worse = 1.4 if axis == "rows" else 1.1  # columns shift the balls more than they blur them
    assert static >= worse * per_row


@pytest.mark.parametrize("axis", ["rows", "columns"])
@pytest.mark.parametrize("readout_deg", [12.0, -12.0])
def test_per_row_keeps_levels_in_short_scans(rt, axis, readout_deg) -> None:
    """No view from the other side hides a wrong weight here; without the filter's scale columns are 4 % off."""
    scan = rolling_scan(axis, readout_deg=readout_deg, arc_deg=220.0)
    volume = fdk(scan, FdkOptions(motion=LineMiddles()), rt).volume
    z, y, x = np.meshgrid(*GRID.axes_mm(), indexing="ij")
    for c, r in BALLS[:2]:
        inside = (x - c[0]) ** 2 + (y - c[1]) ** 2 + (z - c[2]) ** 2 < (0.7 * r) ** 2
        assert abs(volume[inside].mean() - 1) <= FDK_PARTIAL


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_no_motion_is_static(rt, axis) -> None:
    """A global shutter of no exposure: the same volume to rounding, from every motion model."""
    scan = replace(rolling_scan(axis), shutter=Shutter(0.0, 0.0, axis))
    static, per_row = (fdk(scan, FdkOptions(motion=m), rt).volume for m in (Static(), LineMiddles()))
    np.testing.assert_allclose(per_row, static, rtol=0, atol=FLOAT32 * np.abs(static).max())


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_displaced_detectors_with_one_pose_per_line(rt, axis) -> None:
    """Columns are added at the detector's end, and with them lines."""
    pose = GEOMETRY.pose(2 * np.pi * np.arange(VIEWS) / VIEWS)
    frames = line_frames(np.repeat(pose[:, None], PIXELS, 1), "rows")[..., 12:]
    pose[:, 3:6] += 12 * pose[:, 6:9]
    lines = np.repeat(pose[:, None], frames.shape[1 if axis == "rows" else 2], axis=1)
    static = fdk_volume(rt, frames, pose, GRID)
    per_row = fdk_volume(rt, frames, lines, GRID, axis=axis)
    np.testing.assert_allclose(per_row, static, rtol=0, atol=FLOAT32 * np.abs(static).max())
