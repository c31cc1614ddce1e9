"""FDK with a pose for every line: scans that are read out while the gantry turns."""


import numpy as np
import pytest
from balls import balls, frames_of, levels
from tolerances import FDK_LINES, FDK_PARTIAL, FLOAT32

from phyradgs_cl import acquisition
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, LineMiddles, Scan, Shutter, Static
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.fdk import FdkOptions, fdk, fdk_volume

VIEWS, PIXELS = 60, 48
GRID = Grid.cube(36, 2.0)
GEOMETRY = ConeGeometry(6.0, 9.0, (PIXELS, PIXELS), (0.08, 0.08))
PHANTOM = balls(((0.5, 0.1, 0.2), 0.25), ((-0.3, 0.5, -0.3), 0.3), ((0, -0.5, 0.4), 0.2), ((0.1, 0, 0), 0.15))


def rolling_scan(axis: str, direction: int = 1, readout_deg: float = 18.0, arc_deg: float = 360.0) -> Scan:
    """A scan without exposure blur whose gantry turns ``readout_deg`` while a frame is read out."""
    start_s, exposure_s = np.arange(VIEWS) * 1.0, 1e-6
    first, speed_rad_per_s = np.deg2rad(arc_deg) * np.arange(VIEWS) / VIEWS, np.deg2rad(readout_deg) / 0.5
    sweeps = acquisition.FrameSweeps(start_s, exposure_s, first, first + speed_rad_per_s * exposure_s)
    shutter = Shutter(exposure_s, 0.5, axis, direction)
    orbit, delay_s = CircularOrbit(GEOMETRY, sweeps), shutter.delay_s(PIXELS) + exposure_s / 2
    pose = np.stack([orbit.pose(f, start + delay_s) for f, start in enumerate(start_s)])
    return Scan(frames_of(PHANTOM, pose, (PIXELS, PIXELS), axis), GEOMETRY, orbit, shutter, start_s, GRID)


def error(volume: np.ndarray) -> float:
    """Root mean square deviation inside the field of view."""
    z, y, x = np.meshgrid(*GRID.axes_mm(), indexing="ij")
    seen = (np.hypot(x, y) < 0.95) & (np.abs(z) < 0.8)
    return float(np.sqrt(np.mean((volume - PHANTOM.voxelise(GRID))[seen] ** 2)))


@pytest.fixture(scope="module")
def error_at_rest(rt) -> float:
    pose = GEOMETRY.pose(2 * np.pi * np.arange(VIEWS) / VIEWS)
    return error(fdk_volume(rt, frames_of(PHANTOM, pose, (PIXELS, PIXELS)), pose, GRID))


@pytest.mark.parametrize(("axis", "direction"), [("rows", 1), ("columns", -1)])
def test_per_row_undoes_the_readout(rt, error_at_rest, axis, direction) -> None:
    """As good as a gantry at rest, in either direction, where one pose per frame is clearly worse."""
    scan = rolling_scan(axis, direction)
    per_row = error(fdk(scan, FdkOptions(motion=LineMiddles()), rt).volume)
    static = error(fdk(scan, FdkOptions(motion=Static()), rt).volume)
    assert per_row <= FDK_LINES * error_at_rest
    worse = 1.4 if axis == "rows" else 1.1  # columns shift the balls more than they blur them
    assert static >= worse * per_row


@pytest.mark.parametrize(("axis", "readout_deg"), [("rows", -12.0), ("columns", 12.0)])
def test_per_row_keeps_levels_in_short_scans(rt, axis, readout_deg) -> None:
    """No view from the other side hides a wrong weight here; without the filter's scale columns are 4 % off."""
    scan = rolling_scan(axis, readout_deg=readout_deg, arc_deg=220.0)
    volume = fdk(scan, FdkOptions(motion=LineMiddles()), rt).volume
    np.testing.assert_allclose(levels(PHANTOM, volume, GRID)[:2], 1, atol=FDK_PARTIAL)


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_displaced_detectors_with_one_pose_per_line(rt, axis) -> None:
    """Columns are added at the detector's end, and with them lines."""
    pose = GEOMETRY.pose(2 * np.pi * np.arange(VIEWS) / VIEWS)
    frames = frames_of(PHANTOM, pose, (PIXELS, PIXELS))[..., 12:]
    pose[:, 3:6] += 12 * pose[:, 6:9]
    lines = np.repeat(pose[:, None], frames.shape[1 if axis == "rows" else 2], axis=1)
    static = fdk_volume(rt, frames, pose, GRID)
    per_row = fdk_volume(rt, frames, lines, GRID, axis=axis)
    np.testing.assert_allclose(per_row, static, rtol=0, atol=FLOAT32 * np.abs(static).max())
