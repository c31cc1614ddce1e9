"""FDK in absolute units: uniform bodies come out at their own attenuation, whatever the size of the scanner."""

from dataclasses import replace

import numpy as np
import pytest
from balls import frames_of
from scipy.spatial.transform import Rotation
from tolerances import FDK_MEAN, FLOAT32

from phyradgs_cl import acquisition
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, FrameSweeps, Scan, Shutter, Static
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.prepare.step import fill_masked
from phyradgs_cl.reconstructors.fdk import FdkOptions, fdk, fdk_volume, static_fdk

VIEWS, PIXELS, VOXELS = 90, 48, 32


def sphere(half_size_mm: float) -> EllipsoidPhantom:
    centre = (0.1 * half_size_mm, -0.15 * half_size_mm, 0.05 * half_size_mm)
    return EllipsoidPhantom((Ellipsoid(centre, (0.6 * half_size_mm,) * 3, 0.8 / half_size_mm),), "sphere")


def cone(half_size_mm: float) -> ConeGeometry:
    pitch = 3.6 * half_size_mm / PIXELS
    return ConeGeometry(6 * half_size_mm, 9 * half_size_mm, (PIXELS, PIXELS), (pitch, pitch))


FULL_TURN = np.arange(VIEWS) * 2 * np.pi / VIEWS + 0.2


def test_a_sphere_has_its_attenuation_in_1_per_mm(rt) -> None:
    """Of either size; twice as many views over one half of the turn must not brighten it."""
    halves = [np.linspace(0, np.pi, 60, endpoint=False), np.linspace(np.pi, 2 * np.pi, 30, endpoint=False)]
    uneven = np.random.default_rng(0).permutation(np.concatenate(halves))
    z, y, x = np.meshgrid(*Grid.cube(VOXELS, 2.0).axes_mm(), indexing="ij")
    distance = np.hypot(np.hypot(x - 0.1, y + 0.15), z - 0.05)
    outside = (distance > 0.75) & (np.hypot(x, y) < 0.9)
    for half_size_mm, angles in [(1.0, FULL_TURN), (80.0, FULL_TURN), (1.0, uneven)]:
        frames = frames_of(sphere(half_size_mm), pose := cone(half_size_mm).pose(angles), (PIXELS, PIXELS))
        volume = fdk_volume(rt, frames, pose, Grid.cube(VOXELS, 2 * half_size_mm)) * half_size_mm / 0.8
        assert abs(volume[distance < 0.5].mean() - 1) <= FDK_MEAN, half_size_mm
        assert abs(volume[outside].mean()) <= 2 * FDK_MEAN or angles is uneven


def test_scan_and_volume_agree(rt) -> None:
    """Static takes each frame's mid-window pose, static-start its first."""
    geometry, grid = cone(1.0), Grid.cube(8, 2.0)
    frames = np.random.default_rng(62).uniform(0, 1, (5, PIXELS, PIXELS)).astype(np.float32)
    start_s, first = np.arange(5.0), np.arange(5) * 2 * np.pi / 5
    sweeps = FrameSweeps(start_s, 0.5, first, first + 0.1)
    scan = Scan(frames, geometry, CircularOrbit(geometry, sweeps), Shutter(0.5, 0.25), start_s, grid)
    middle, begun = (fdk(scan, FdkOptions(motion=motion), rt).volume for motion in (Static(), acquisition.StaticStart()))
    for volume, angles in ((middle, first + 0.1 * 1.5 / 2), (begun, first)):
        np.testing.assert_allclose(volume, fdk_volume(rt, frames, geometry.pose(angles), grid), rtol=0, atol=FLOAT32)
    assert np.abs(begun - middle).max() > 1e-3


def test_frames_that_are_masked_whole_are_as_if_they_were_not_there(rt) -> None:
    """Their neighbours stand for them: the body keeps its level, here and where other methods begin."""
    geometry, grid = cone(1.0), Grid.cube(VOXELS, 2.0)
    frames, start_s = frames_of(sphere(1.0), geometry.pose(FULL_TURN), (PIXELS, PIXELS)), np.arange(float(VIEWS))
    sweeps = FrameSweeps(start_s, 0.0, FULL_TURN, FULL_TURN)
    scan = Scan(frames, geometry, CircularOrbit(geometry, sweeps), Shutter(0.0), start_s, grid, is_fly=False)
    lost = np.zeros(scan.projections.shape, bool)
    lost[[7, 40, 71]] = True
    lost[9, 3] = True  # a row is filled in from those beside it
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    body = np.hypot(np.hypot(x - 0.1, y + 0.15), z - 0.05) < 0.5
    for make in (lambda s: fdk(s, FdkOptions(), rt).volume, lambda s: static_fdk(rt, s)):
        volume = make(replace(scan, pixel_mask=lost, projections=np.where(lost, np.float32(9), frames)))
        assert abs(volume[body].mean() / make(scan)[body].mean() - 1) < 1e-3


def test_masked_pixels_are_filled_along_their_row() -> None:
    frames, mask = np.tile(np.arange(6, dtype=np.float32), (2, 3, 1)), np.zeros((2, 3, 6), bool)
    mask[0, 1, 2:4] = mask[1, 2, 0] = mask[1, 0, :] = True
    spoiled = np.where(mask, np.float32(1e6), frames)
    filled, expected = fill_masked(spoiled, mask), frames.copy()
    expected[1, 2, 0] = 1.0  # rows without a pixel: from those beside them
    np.testing.assert_array_equal(filled, expected)
    assert spoiled.max() == 1e6  # the caller's frames are left alone


def test_orbits_that_are_no_circle_about_z_are_told_and_refused(rt, caplog) -> None:
    """A circle, displaced, short, jittered or off by a pixel, is none of them. What is right is not spoken of."""
    geometry = ConeGeometry(5.0, 7.0, (12, 12), (0.3, 0.3))
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    circle = geometry.pose(angle)

    def lifted(feed_mm: float) -> np.ndarray:
        return circle + np.outer(feed_mm * (angle / np.pi - 1), np.eye(12)[2] + np.eye(12)[5])

    def turned(axis: str, deg: float, poses: np.ndarray = circle) -> np.ndarray:
        return (poses.reshape(-1, 4, 3) @ Rotation.from_euler(axis, deg, degrees=True).as_matrix().T).reshape(-1, 12)

    def tilted(deg: float) -> np.ndarray:
        beam = turned("y", -deg, geometry.pose(0.0))[0].reshape(4, 3)
        return np.concatenate([(beam @ Rotation.from_euler("z", a).as_matrix().T).reshape(1, 12) for a in angle])

    cases = {
        "circle": (circle, 0), "half-fan": (replace(geometry, detector_offset_mm=(0.0, 0.9)).pose(angle), 0),
        "shaken": (circle + 0.05 * np.random.default_rng(0).normal(size=(20, 1)) * np.eye(12)[3], 0),
        "helix": (lifted(1.0), 1), "laminography": (tilted(20), 1), "steep": (tilted(50), 2),
        "about y": (turned("x", 90), 2),
    }  # fmt: skip
    off, above = "off a circle about z", "above the middle of their circle"
    wrong = {"helix": (off,), "laminography": (above,), "steep": (above,), "about y": (off,)}
    for name, (poses, worst) in cases.items():
        caplog.clear()
        scan = Scan.from_poses(np.ones((20, 12, 12), np.float32), poses, Grid.cube(8, 1.0))
        if worst == 2:
            with pytest.raises(InputError, match="any orbit") as refusal:
                fdk(scan, FdkOptions(), rt)
            text = refusal.value.found
        else:
            fdk(scan, FdkOptions(), rt)
            text = caplog.text
        assert tuple(words for words in (off, above) if words in text) == wrong.get(name, ()), (name, text)


def test_rows_along_the_axis_are_refused(rt, caplog) -> None:
    """FDK filters along detector rows: of a panel on its side the volume was zero, without a word."""
    circle = ConeGeometry(6.0, 9.0, (12, 12), 0.5).pose(np.linspace(0, 2 * np.pi, 20, endpoint=False)).reshape(-1, 4, 3)
    middle = circle[:, 1] + 5.5 * (circle[:, 2] + circle[:, 3])
    for roll_deg, worst in ((1.0, 0), (5.0, 1), (45.0, 2), (90.0, 2), (180.0, 0), (-90.0, 2)):
        caplog.clear()
        c, s = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
        u, v = c * circle[:, 2] + s * circle[:, 3], c * circle[:, 3] - s * circle[:, 2]
        poses = np.stack([circle[:, 0], middle - 5.5 * (u + v), u, v], 1).reshape(-1, 12)
        scan = Scan.from_poses(np.ones((20, 12, 12), np.float32), poses, Grid.cube(8, 1.0))
        if worst == 2:
            with pytest.raises(InputError, match="detector rows .* off the plane of the rotation"):
                fdk(scan, FdkOptions(), rt)
        else:
            fdk(scan, FdkOptions(), rt)
            assert ("detector rows" in caplog.text) == (worst == 1), roll_deg
