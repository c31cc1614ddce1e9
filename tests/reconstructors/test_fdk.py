"""FDK in absolute units: uniform bodies come out at their own attenuation, whatever the size of the scanner."""

from dataclasses import replace

import numpy as np
import pytest
from balls import frames_of
from scipy.spatial.transform import Rotation
from tolerances import FDK_MEAN, FLOAT32, FLOAT64, RAMP

from phyradgs_cl import acquisition
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, FrameSweeps, Scan, Shutter, Static
from phyradgs_cl.api import reconstruct, simulate
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.reconstructors.fdk import FdkOptions, fdk, fdk_volume, ramp_filter, ramp_spectrum, static_fdk
from phyradgs_cl.reconstructors.fdk.frames import extrapolated, reprojected
from phyradgs_cl.reconstructors.fdk.views import Views

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


def test_orbits_that_are_no_circle_about_z_and_rows_off_its_plane_are_told_and_refused(rt, caplog) -> None:
    """A circle, displaced, jittered or turned over, is none of them. What is right is not spoken of. Of a panel on its side
    the volume was zero, without a word."""
    geometry = ConeGeometry(5.0, 7.0, (12, 12), (0.3, 0.3))
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    circle, displaced = geometry.pose(angle), replace(geometry, detector_offset_mm=(0.0, 0.9))

    def lifted(feed_mm: float) -> np.ndarray:
        return circle + np.outer(feed_mm * (angle / np.pi - 1), np.eye(12)[2] + np.eye(12)[5])

    def turned(axis: str, deg: float, poses: np.ndarray = circle) -> np.ndarray:
        return (poses.reshape(-1, 4, 3) @ Rotation.from_euler(axis, deg, degrees=True).as_matrix().T).reshape(-1, 12)

    def tilted(deg: float) -> np.ndarray:
        beam = turned("y", -deg, geometry.pose(0.0))[0].reshape(4, 3)
        return np.concatenate([(beam @ Rotation.from_euler("z", a).as_matrix().T).reshape(1, 12) for a in angle])

    def rolled(deg: float) -> np.ndarray:
        source, corner, across, up = circle.reshape(-1, 4, 3).swapaxes(0, 1)
        c, s = np.cos(np.deg2rad(deg)), np.sin(np.deg2rad(deg))
        u, v = c * across + s * up, c * up - s * across
        return np.stack([source, corner + 5.5 * (across + up - u - v), u, v], 1).reshape(-1, 12)

    off, above, rows = "off a circle about z", "above the middle of their circle", "detector rows"
    for name, poses, said, is_refused in (
        ("circle", circle, None, False), ("half-fan", displaced.pose(angle), None, False),
        ("shaken", circle + 0.05 * np.random.default_rng(0).normal(size=(20, 1)) * np.eye(12)[3], None, False),
        ("helix", lifted(1.0), off, False), ("laminography", tilted(20), above, False), ("steep", tilted(50), above, True),
        ("about y", turned("x", 90), off, True), ("by 1°", rolled(1.0), None, False), ("by 5°", rolled(5.0), rows, False),
        ("half", rolled(45.0), rows, True), ("on a side", rolled(90.0), rows, True), ("over", rolled(180.0), None, False),
        ("the other side", rolled(-90.0), rows, True),
    ):  # fmt: skip
        caplog.clear()
        scan = Scan.from_poses(np.ones((20, 12, 12), np.float32), poses, Grid.cube(8, 1.0))
        try:
            fdk(scan, FdkOptions(), rt)
            refusal = None
        except InputError as error:
            refusal = error
            assert ("off the plane of the rotation" if said == rows else "any orbit") in str(error), name
        text = refusal.found if refusal else caplog.text
        assert [words for words in (off, above, rows) if words in text] == [said] * bool(said), (name, text)
        assert bool(refusal) == is_refused, name


@pytest.mark.parametrize("width", [1, 2, 17, 64])
def test_ramp_filter_is_a_convolution(width) -> None:
    """Kak and Slaney's kernel h(0) = 1/4τ², h(odd n) = −1/(πnτ)², times τ, without wrapping around."""
    spacing_mm, n, kernel = 0.37, np.arange(-(width - 1), width), np.zeros(2 * width - 1)
    kernel[n % 2 != 0] = -1 / (np.pi * n[n % 2 != 0] * spacing_mm) ** 2
    kernel[n == 0] = 1 / (4 * spacing_mm**2)
    for dtype in (np.float32, np.float64):
        rows = np.random.default_rng(63).normal(size=(3, width)).astype(dtype)
        expected = np.stack([np.convolve(row, kernel) for row in rows])[:, width - 1 : 2 * width - 1] * spacing_mm
        found = ramp_filter(rows, spacing_mm)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected, rtol=0, atol=RAMP * np.abs(expected).max())


def test_spectra_of_the_ramp_and_its_windows() -> None:
    """And a row of odd length, which has no sample at that frequency."""
    sinc = np.sin(np.pi / 4) / (np.pi / 4)
    at = {"ram-lak": (1, 1), "shepp-logan": (sinc, 2 / np.pi), "cosine": (np.sqrt(0.5), 0), "hamming": (0.54, 0.08)}
    for window, (quarter, nyquist) in {**at, "hann": (0.5, 0)}.items():
        ratio = ramp_spectrum(256, window) / ramp_spectrum(256)
        assert ratio[[0, 64, 128]] == pytest.approx([1, quarter, nyquist], rel=FLOAT64, abs=FLOAT64), window
    ratio = ramp_spectrum(225, "hann") / ramp_spectrum(225)
    np.testing.assert_allclose(ratio, 0.5 + 0.5 * np.cos(2 * np.pi * np.arange(113) / 225), rtol=FLOAT64)
    spectrum = ramp_spectrum(256)
    np.testing.assert_allclose(spectrum, np.arange(129) / 256, atol=0.01)
    assert 0 < spectrum[0] < 0.002


def test_noise_falls_from_window_to_window(rt) -> None:
    geometry = ConeGeometry(6.0, 9.0, (8, 48), (0.075, 0.075))
    pose = geometry.pose(np.arange(40) * 2 * np.pi / 40)
    frames = np.random.default_rng(66).normal(size=(40, 8, 48)).astype(np.float32)
    grid = Grid((2, 24, 24), (0.05, 0.06, 0.06))
    windows = ["ram-lak", "shepp-logan", "cosine", "hamming", "hann"]
    noise = [fdk_volume(rt, frames, pose, grid, window=window).std() for window in windows]
    assert all(after < 0.97 * before for before, after in zip(noise[:-1], noise[1:], strict=True))


BEYOND = 20  # pixels at each side of a panel of 41


@pytest.mark.parametrize(("way", "worst"), [("cylinder", 0.4), ("cosine", 0.65)])
def test_rows_go_on_as_the_object_might(way, worst) -> None:
    """Two frames of two lines: a cylinder that is cut off, and one that ends inside of the panel, with air at both edges."""
    u = np.arange(-20.0 - BEYOND, 21 + BEYOND)
    wide = 0.1 * np.sqrt(np.maximum(np.array([[27.0], [12.0]]) ** 2 - u**2, 0))
    frames = wide[:, BEYOND:-BEYOND].astype(np.float32)
    found, count = extrapolated(np.stack([frames, frames]), way)
    assert count == BEYOND and found.shape == (2, *wide.shape) and found.dtype == np.float32
    np.testing.assert_array_equal(found[..., BEYOND:-BEYOND], np.stack([frames, frames]))
    np.testing.assert_array_equal(found[:, 1], np.broadcast_to(np.pad(frames[1], BEYOND), (2, u.size)))
    np.testing.assert_allclose(found[..., ::-1], found, atol=1e-5)  # as the object
    off = np.abs(found[:, 0] - wide[0]).max()
    assert off < worst * frames.max() and (found[..., [0, -1]] < 1e-5).all()


def test_the_cut_rings_less_into_a_truncated_body(rt) -> None:
    """A cylinder that the panel sees four fifths of, be the panel a pixel off centre as real ones are."""
    angles = np.arange(60) * 2 * np.pi / 60
    body = EllipsoidPhantom((Ellipsoid((0.0, 0.0, 0.0), (1.0, 1.0, 8.0), 0.5),), "cylinder")

    def volume(way: str, offset_mm: float = 0.0) -> np.ndarray:
        pose = ConeGeometry(8.0, 8.8, (4, 40), (0.044, 0.044), (0.0, offset_mm)).pose(angles)
        return fdk_volume(rt, frames_of(body, pose, (4, 40)), pose, grid, extrapolate=way)

    grid = Grid((1, 32, 32), (0.05, 0.05, 0.05))
    y, x = np.meshgrid(*grid.axes_mm()[1:], indexing="ij")
    radius_mm = np.hypot(x, y)
    for offset_mm in (0.0, 0.06):
        rise = {}
        for way in ("none", "cosine", "cylinder"):
            middle = volume(way, offset_mm)[0]
            rise[way] = middle[(radius_mm > 0.5) & (radius_mm < 0.7)].mean() / middle[radius_mm < 0.2].mean() - 1
        assert rise["none"] > 0.33 and max(rise["cosine"], rise["cylinder"]) < 0.65 * rise["none"]


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_rows_go_on_as_a_volume_has_them(rt, axis) -> None:
    """Half the columns of a wide panel, with a pose for every line; lines beyond the panel have the pose of the last."""
    body = EllipsoidPhantom((Ellipsoid((0.1, 0.0, 0.0), (0.7, 0.9, 0.6), 0.5),), "ball")
    grid = Grid((24, 40, 40), (0.05, 0.05, 0.05))
    lines = np.arange(8) if axis == "rows" else np.clip(np.arange(-10, 30), 0, 19)
    angles = np.arange(3)[:, None] + 0.01 * lines
    full, half = (ConeGeometry(8.0, 10.0, (8, columns), (0.15, 0.07)).pose(angles) for columns in (40, 20))
    whole = frames_of(body, full, (8, 40), axis)
    poses = half if axis == "rows" else half[:, 10:30]
    frames = whole[..., 10:30]
    found, count = reprojected(rt, frames, Views(poses, frames.shape[1:], axis), body.voxelise(grid), grid)
    np.testing.assert_array_equal(found[..., count : count + 20], frames)
    assert count >= 10 and np.abs(whole[..., :10]).max() > 0.1
    off = found[..., count - 10 : count + 30] - whole
    # a pixel three voxels high is the mean of its rays, where the frames have one in its middle
    assert np.sqrt(np.mean(off**2)) < 0.03 * np.sqrt(np.mean(whole**2))
    assert not found[..., [0, -1]].any()  # all of the grid is seen


def test_rows_that_are_not_extrapolated_cost_no_reconstruction(rt, caplog) -> None:
    aside = simulate("jaw", size=12, detector=16, views=12, detector_offset_mm=(0.0, 0.6), device=rt)
    told = []
    found = reconstruct(aside, "fdk", extrapolate="reprojected", device=rt, report=told.append)
    assert "displaced detector are not extrapolated" in caplog.text and not any("beyond" in p.quantity for p in told)
    np.testing.assert_array_equal(found.volume, reconstruct(aside, "fdk", device=rt, report=False).volume)


def test_a_box_of_an_object_wider_than_the_panel(rt) -> None:
    """Three quarters of what the lost columns cost are regained, and a whole panel's volume stays as it was; Ctrl-C ends
    it before there is a volume."""
    usual = {"size": 16, "detector": 24, "views": 24, "exposure_deg": 5.0, "device": rt}
    whole, cut = simulate("jaw", **usual), simulate("jaw", **usual, truncation=0.6)
    box = {"roi_mm": [0.375 * side for side in whole.grid.size_mm], "device": rt, "motion": "per-row"}
    more = {"margin_mm": 3 * whole.grid.voxel_size_mm[0], "extrapolate": "reprojected"}
    best, same, spoilt, regained = (
        reconstruct(scan, "fdk", **box, **how).volume for scan in (whole, cut) for how in ({}, more)
    )
    np.testing.assert_allclose(same, best, atol=0.02 * best.max())
    error = [float(np.sqrt(np.mean((volume - best) ** 2))) for volume in (spoilt, regained)]
    assert error[1] < 0.25 * error[0], error

    def stop(progress) -> None:
        assert "beyond the panel" in progress.quantity and progress.state is None
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="before there was a volume"):
        reconstruct(cut, "fdk", **box, **more, report=stop)
