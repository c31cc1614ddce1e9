"""Rows of a panel that is narrower than the object, continued: what is said of the rays beyond, and what FDK makes of it."""

import numpy as np
import pytest
from balls import frames_of

from phyradgs_cl.acquisition import ConeGeometry
from phyradgs_cl.api import reconstruct, simulate
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.reconstructors.fdk import fdk_volume
from phyradgs_cl.reconstructors.fdk.frames import extrapolated, reprojected
from phyradgs_cl.reconstructors.fdk.views import Views

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


def test_the_cut_rings_less_into_a_truncated_body(rt, caplog) -> None:
    """A cylinder that the panel sees four fifths of, be the panel a pixel off centre as real ones are; one that is put aside
    keeps its own weights, and that is said."""
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
    np.testing.assert_array_equal(volume("cylinder", 0.4), volume("none", 0.4))
    assert "displaced detector are not extrapolated" in caplog.text


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
