"""Half-fans: the offset is what rays and their opposites say, and fits judge the rest."""

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, pixel_centres
from phyradgs_cl.api import static_scan
from phyradgs_cl.calibrate import CORRECTED, calibrate
from phyradgs_cl.calibrate.search import Fallback, Search
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

pytestmark = pytest.mark.slow

TRUE_PX, STATED_PX, PITCH_MM = 28.0, 26.0, 0.56
BODY = EllipsoidPhantom(
    (
        Ellipsoid((0.0, 0.0, 0.0), (16.0, 14.0, 6.0), 0.012), Ellipsoid((9.0, 3.0, 1.0), (1.6,) * 3, 0.02),
        Ellipsoid((-4.0, 5.0, -1.0), (2.0,) * 3, 0.01), Ellipsoid((1.0, -3.0, 0.0), (1.2,) * 3, 0.03),
    ),
    "body",
)  # fmt: skip


def half_fan():
    shape, pitch_mm = (24, 64), (1.1, PITCH_MM)
    true, stated = (ConeGeometry(150.0, 220.0, shape, pitch_mm, (0.0, px * PITCH_MM)) for px in (TRUE_PX, STATED_PX))
    angles_deg = 3.0 * np.arange(120)
    pose = true.pose(np.deg2rad(angles_deg))
    frames = BODY.line_integrals(pose[:, None, None, :3], pixel_centres(pose, shape))
    frames = frames + 0.002 * np.random.default_rng(0).standard_normal(frames.shape)
    return static_scan(frames.astype(np.float32), stated, angles_deg)


def test_the_offset_is_no_shift_that_fits_better(rt) -> None:
    """A shift that leaves fewer rays measured twice always fits better: 27 pixels became 36 where 28 were true."""
    (offset,) = calibrate(half_fan(), rt, "offset-u").parameters
    assert offset.verdict == CORRECTED
    assert offset.found == pytest.approx(TRUE_PX * PITCH_MM, abs=0.2 * PITCH_MM)


def test_a_worse_fit_takes_back_all_but_what_is_held() -> None:
    known = Fallback(1.0, 0.01, is_significant=True)
    search = Search((), held=("offset-u",), fixed={"offset-u": known, "offset-v": known}, determined=("roll",))
    search.keep_held()
    assert search.corrections() == {"offset-u": 1.0}
    search.held = ()
    search.keep_held()
    assert search.corrections() == {}
