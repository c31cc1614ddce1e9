"""Filtered backprojection of parallel beams: half turns, full turns, an axis near the panel's edge, lines at own angles."""

import numpy as np
import pytest

from phyradgs_cl.acquisition import (
    CircularOrbit,
    ConstantSpeed,
    LineMiddles,
    ParallelGeometry,
    Scan,
    Shutter,
    Static,
    pixel_centres,
)
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.reconstructors.fdk import FdkOptions, fbp, fdk

SIDE, ROWS = 64, 5
GRID = Grid((3, SIDE, SIDE), (1.0, 1.0, 1.0))
DISC = EllipsoidPhantom((Ellipsoid((6.0, -4.0, 0.0), (14.0, 14.0, 1000.0), 0.02),), "disc")


def scan_of(
    views: int, turn_deg: float, offset_mm: float = 0.0, columns: int = SIDE, shutter: Shutter | None = None
) -> Scan:
    """A parallel scan of the disc, every line exact at its own time where a shutter is given."""
    geometry = ParallelGeometry((ROWS, columns), 1.0, (0.0, offset_mm))
    orbit, start_s = CircularOrbit(geometry, ConstantSpeed(0.3, np.deg2rad(turn_deg) / views)), np.arange(float(views))
    frames = np.empty((views, ROWS, columns), np.float32)
    middles_s = (shutter or Shutter(0.0)).line_windows_s(ROWS).mean(1)
    for frame, line in np.ndindex(views, ROWS):
        pose = orbit.pose(frame, start_s[frame] + middles_s[line])
        pixels = pixel_centres(pose, (ROWS, columns))[line]
        frames[frame, line] = DISC.line_integrals(pixels - 200 * pose[:3], pixels + 200 * pose[:3])
    return Scan(frames, geometry, orbit, shutter or Shutter(0.0), start_s, GRID, shutter is not None)


def error_of(volume: np.ndarray) -> float:
    """RMS over the disc's density, inside the largest circle and off the disc's edge."""
    z, y, x = np.meshgrid(*GRID.axes_mm(), indexing="ij")
    from_edge = np.abs(np.hypot(x - 6, y + 4) - 14)
    where = (np.hypot(x, y) < SIDE / 2 - 2) & (from_edge > 2)
    return float(np.sqrt(np.mean((volume - DISC.density(x, y, z))[where] ** 2)) / 0.02)


@pytest.mark.parametrize(
    ("views", "turn_deg", "offset_mm", "columns"),
    [(90, 180, 0.0, SIDE), (180, 360, 0.0, SIDE), (110, 220, 0.0, SIDE), (180, 360, 0.25, SIDE), (180, 360, 14.0, 40)],
    ids=["half", "full", "more than half", "a quarter pixel off", "half-acquisition"],
)
def test_a_disc_comes_out_with_its_density(rt, views: int, turn_deg: float, offset_mm: float, columns: int) -> None:
    assert error_of(fbp(scan_of(views, turn_deg, offset_mm, columns), FdkOptions(), rt).volume) < 0.03


def test_lines_are_backprojected_at_their_own_angles(rt) -> None:
    """A readout of nearly a frame's time: lines lie up to 5 degrees from the frame's middle."""
    scan = scan_of(36, 360, shutter=Shutter(0.02, 0.95))
    known, static = (fbp(scan, FdkOptions(motion=motion), rt).volume for motion in (LineMiddles(), Static()))
    off = [np.abs(volume[[0, -1]] - volume[[1]]).mean() for volume in (known, static)]
    assert off[0] < 0.5 * off[1]


def test_each_beam_has_its_method(rt) -> None:
    with pytest.raises(InputError, match="parallel beam"):
        fdk(scan_of(8, 180), FdkOptions(), rt)


def test_laminography_is_refused_in_one_line(rt) -> None:
    scan = scan_of(8, 180)
    poses = np.stack([scan.trajectory.pose(f, np.array(float(f))) for f in range(8)])
    poses[:, :3] = poses[:, :3] * np.cos(0.5) + [0, 0, np.sin(0.5)]
    tilted = Scan.from_poses(scan.projections, poses, GRID, is_parallel=True)
    with pytest.raises(InputError, match="laminography"):
        fbp(tilted, FdkOptions(), rt)
