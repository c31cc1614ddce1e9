"""The axis of half-fans from rays that are measured twice: no shift wins because it leaves fewer of them."""

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, pixel_centres
from phyradgs_cl.api import static_scan
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.reconstructors.fits.twice import shift_by_rays_seen_twice

pytestmark = pytest.mark.slow

BODY = EllipsoidPhantom(
    (
        Ellipsoid((0.0, 0.0, 0.0), (16.0, 14.0, 6.0), 0.012), Ellipsoid((9.0, 3.0, 1.0), (1.6,) * 3, 0.02),
        Ellipsoid((-4.0, 5.0, -1.0), (2.0,) * 3, 0.01), Ellipsoid((1.0, -3.0, 0.0), (1.2,) * 3, 0.03),
    ),
    "body",
)  # fmt: skip


@pytest.mark.parametrize(("true_px", "stated_px"), [(28.0, 27.0), (-25.0, -22.0), (20.0, 26.0)])
def test_the_true_place_of_the_panel(true_px, stated_px) -> None:
    shape, pitch_mm = (24, 64), (1.1, 0.56)
    true, stated = (ConeGeometry(150.0, 220.0, shape, pitch_mm, (0.0, px * 0.56)) for px in (true_px, stated_px))
    angles_deg = 3.0 * np.arange(120)
    pose = true.pose(np.deg2rad(angles_deg))
    frames = BODY.line_integrals(pose[:, None, None, :3], pixel_centres(pose, shape))
    frames = frames + 0.003 * np.random.default_rng(0).standard_normal(frames.shape)
    shift = shift_by_rays_seen_twice(static_scan(frames.astype(np.float32), stated, angles_deg))
    assert shift.pixels == pytest.approx(true_px - stated_px, abs=0.1)
    assert shift.deviation < 0.1
