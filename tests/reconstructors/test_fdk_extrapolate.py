"""Rows of a panel that is narrower than the object, continued: what is said of the rays beyond, and what FDK makes of it."""

import logging

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, pixel_centres
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.reconstructors.fdk import fdk_volume
from phyradgs_cl.reconstructors.fdk.extrapolate import extrapolated

BEYOND = 20  # pixels at each side of a panel of 41


def chords(radius: float, u: np.ndarray) -> np.ndarray:
    return 0.1 * np.sqrt(np.maximum(radius**2 - u**2, 0))


@pytest.mark.parametrize(("way", "worst"), [("cylinder", 0.4), ("cosine", 0.65)])
def test_rows_go_on_as_the_object_might(way, worst) -> None:
    """Two frames of two lines: a cylinder that is cut off, and one that ends inside of the panel, with air at both edges."""
    inside, wide = np.arange(-20.0, 21), np.arange(-20.0 - BEYOND, 21 + BEYOND)
    frames = np.stack([chords(radius, inside) for radius in (27.0, 12.0)]).astype(np.float32)
    found, count = extrapolated(np.stack([frames, frames]), way)
    assert count == BEYOND and found.shape == (2, 2, wide.size) and found.dtype == np.float32
    np.testing.assert_array_equal(found[..., BEYOND:-BEYOND], np.stack([frames, frames]))
    np.testing.assert_array_equal(found[:, 1], np.broadcast_to(np.pad(frames[1], BEYOND), (2, wide.size)))
    np.testing.assert_allclose(found[..., ::-1], found, atol=1e-5)  # as the object
    off = np.abs(found[:, 0] - chords(27.0, wide)).max()
    assert off < worst * frames.max() and (found[..., [0, -1]] < 1e-5).all()


def test_the_cut_rings_less_into_a_truncated_body(rt, caplog) -> None:
    """A cylinder that the panel sees four fifths of, be the panel a pixel off centre as real ones are; one that is put aside
    keeps its own weights, and that is said."""
    angles = np.arange(60) * 2 * np.pi / 60
    body = EllipsoidPhantom((Ellipsoid((0.0, 0.0, 0.0), (1.0, 1.0, 8.0), 0.5),), "cylinder")

    def volume(way: str, offset_mm: float = 0.0) -> np.ndarray:
        pose = ConeGeometry(8.0, 8.8, (4, 40), (0.044, 0.044), (0.0, offset_mm)).pose(angles)
        frames = body.line_integrals(pose[:, None, None, :3], pixel_centres(pose, (4, 40))).astype(np.float32)
        return fdk_volume(rt, frames, pose, Grid((1, 32, 32), (0.05, 0.05, 0.05)), extrapolate=way)

    y, x = np.meshgrid(*Grid((1, 32, 32), (0.05, 0.05, 0.05)).axes_mm()[1:], indexing="ij")
    radius_mm = np.hypot(x, y)
    for offset_mm in (0.0, 0.06):
        rise = {}
        for way in ("none", "cosine", "cylinder"):
            middle = volume(way, offset_mm)[0]
            rise[way] = middle[(radius_mm > 0.5) & (radius_mm < 0.7)].mean() / middle[radius_mm < 0.2].mean() - 1
        assert rise["none"] > 0.33 and max(rise["cosine"], rise["cylinder"]) < 0.65 * rise["none"]
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(volume("cylinder", 0.4), volume("none", 0.4))
    assert "displaced detector are not extrapolated" in caplog.text
