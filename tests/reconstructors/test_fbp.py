"""Filtered backprojection of parallel beams: half turns, full turns, an axis near the panel's edge, lines at own angles."""

import numpy as np
import pytest
from balls import frames_of

from phyradgs_cl import acquisition
from phyradgs_cl.acquisition import CircularOrbit, LineMiddles, ParallelGeometry, Scan, Shutter, Static
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.reconstructors.fdk import FbpOptions, fdk, fdk_volume

SIDE, ROWS = 64, 5
GRID = Grid((3, SIDE, SIDE), (1.0, 1.0, 1.0))
DISC = EllipsoidPhantom((Ellipsoid((6.0, -4.0, 0.0), (14.0, 14.0, 1000.0), 0.02),), "disc")


def scan_of(views: int, turn_deg: float, offset_mm: float = 0.0, columns: int = SIDE, shutter: Shutter | None = None):
    """A parallel scan of the disc, every line exact at its own time where a shutter is given."""
    geometry = ParallelGeometry((ROWS, columns), 1.0, (0.0, offset_mm))
    speed, start_s = acquisition.ConstantSpeed(0.3, np.deg2rad(turn_deg) / views), np.arange(float(views))
    orbit = CircularOrbit(geometry, speed)
    poses = [orbit.pose(0, start_s + middle_s) for middle_s in (shutter or Shutter(0.0)).line_windows_s(ROWS).mean(1)]
    frames = frames_of(DISC, np.stack(poses, 1), (ROWS, columns), is_parallel=True)
    return Scan(frames, geometry, orbit, shutter or Shutter(0.0), start_s, GRID, shutter is not None)


@pytest.mark.parametrize(("views", "turn_deg", "offset_mm", "columns"), [
    (90, 180, 0.0, SIDE), (180, 360, 0.0, SIDE), (110, 220, 0.0, SIDE), (180, 360, 0.25, SIDE), (180, 360, 14.0, 40),
], ids=["half", "full", "more than half", "a quarter pixel off", "half-acquisition"])  # fmt: skip
def test_a_disc_comes_out_with_its_density(rt, views, turn_deg, offset_mm, columns) -> None:
    """RMS over the disc's density, inside the largest circle and off the disc's edge."""
    volume = fdk(scan_of(views, turn_deg, offset_mm, columns), FbpOptions(), rt).volume
    z, y, x = np.meshgrid(*GRID.axes_mm(), indexing="ij")
    from_edge = np.abs(np.hypot(x - 6, y + 4) - 14)
    where = (np.hypot(x, y) < SIDE / 2 - 2) & (from_edge > 2)
    assert np.sqrt(np.mean((volume - DISC.density(x, y, z))[where] ** 2)) < 0.03 * 0.02


@pytest.mark.parametrize(("slant_deg", "views", "turn_deg", "offset_mm"), [
    (20, 90, 180, 0.0), (-40, 110, 220, 0.0), (50, 180, 360, 9.0),
])  # fmt: skip
def test_a_panel_slanted_to_the_rays_keeps_densities(rt, slant_deg, views, turn_deg, offset_mm) -> None:
    """Its columns are nearer together across the rays."""
    pose = scan_of(views, turn_deg, offset_mm).trajectory.pose(0, np.arange(float(views)))
    across = np.cos(np.deg2rad(slant_deg)) * pose[:, 6:9] + np.sin(np.deg2rad(slant_deg)) * pose[:, :3]
    side = 100
    pose[:, 3:6] = (offset_mm - (side - 1) / 2) * across - (ROWS - 1) / 2 * pose[:, 9:12]
    pose[:, 6:9] = across
    frames = frames_of(DISC, pose, (ROWS, side), is_parallel=True)
    volume, (_, y, x) = fdk_volume(rt, frames, pose, GRID, is_parallel=True), np.meshgrid(*GRID.axes_mm(), indexing="ij")
    assert volume[np.hypot(x - 6, y + 4) < 11].mean() == pytest.approx(0.02, rel=0.01)


@pytest.mark.parametrize(("views", "turn_deg", "offset_mm", "columns", "radius_mm"), [
    (90, 180, 0.0, 48, 24.0), (180, 360, 0.0, 48, 24.0), (180, 360, 10.0, 40, 30.0),
], ids=["half", "full", "half-acquisition"])  # fmt: skip
def test_the_volume_ends_at_the_circle_of_the_field_of_view(rt, views, turn_deg, offset_mm, columns, radius_mm) -> None:
    """Half-acquisition keeps the wider circle, which a full turn measures; rows that are continued keep the corners."""
    scan, (_, y, x) = scan_of(views, turn_deg, offset_mm, columns), np.meshgrid(*GRID.axes_mm(), indexing="ij")
    cut, whole = (fdk(scan, FbpOptions(circle=circle), rt).volume for circle in (True, False))
    inside = np.hypot(x, y) <= radius_mm
    np.testing.assert_array_equal(cut, np.where(inside, whole, 0))
    assert np.abs(whole[~inside]).max() > 1e-4
    if offset_mm == 0:
        assert np.abs(fdk(scan, FbpOptions(extrapolate="cosine"), rt).volume[~inside]).max() > 1e-4


def test_lines_are_backprojected_at_their_own_angles(rt) -> None:
    """A readout of nearly a frame's time: lines lie up to 5 degrees from the frame's middle."""
    scan, (_, y, x) = scan_of(36, 360, shutter=Shutter(0.02, 0.95)), np.meshgrid(*GRID.axes_mm(), indexing="ij")
    off = []
    for motion in (LineMiddles(), Static()):
        lowest = np.where(np.hypot(x - 6, y + 4) < 20, fdk(scan, FbpOptions(motion=motion), rt).volume, 0)[0]
        centre = [float((lowest * axis[0]).sum() / lowest.sum()) for axis in (x, y)]
        off.append(np.hypot(centre[0] - 6, centre[1] + 4))
    assert off[0] < 0.03 and off[1] > 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("views", "turn_deg"), [(90, 180), (180, 360)], ids=["half", "full"])
def test_deblurring_along_the_angle_undoes_an_exposure(rt, views: int, turn_deg: float) -> None:
    """Frames averaged over 31 times of an arc of 6 degrees, 3 pixels at the rim: the volume of a gantry that stops."""
    speed, still = np.deg2rad(turn_deg) / views, scan_of(views, turn_deg)
    fine, arc_steps = scan_of(10 * views, turn_deg), round(np.deg2rad(6) / (speed / 10))
    both = fine.projections[..., :: 1 if turn_deg == 360 else -1]  # behind half a turn the rays come back mirrored
    both = np.concatenate([fine.projections, both])
    frames = [np.roll(both, -k, axis=0)[: 10 * views] for k in range(-(arc_steps // 2), arc_steps // 2 + 1)]
    blurred = np.mean(frames, axis=0, dtype=np.float64)[::10].astype(np.float32)
    start_s = np.arange(float(views)) - (exposure_s := np.deg2rad(6) / speed) / 2
    moving = Scan(blurred, still.geometry, still.trajectory, Shutter(exposure_s), start_s, GRID)
    plain, sharp = (fdk(moving, FbpOptions(deblur=noise), rt).volume for noise in (0.0, 1e-4))
    target = fdk(still, FbpOptions(), rt).volume
    assert np.linalg.norm(sharp - target) < 0.5 * np.linalg.norm(plain - target)
    np.testing.assert_array_equal(fdk(still, FbpOptions(deblur=0.01), rt).volume, target)
    with pytest.raises(InputError, match="evenly spaced"):
        uneven = Scan(blurred[::-1], still.geometry, still.trajectory, Shutter(exposure_s), start_s**2 / views, GRID)
        fdk(uneven, FbpOptions(deblur=0.01), rt)
