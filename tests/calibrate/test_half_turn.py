"""Half a turn of nearly parallel rays: too little of an offset's signal is its own, but the best axis is known. Half-fans:
the offset is what rays and their opposites say, and fits judge the rest."""

import numpy as np
import pytest
from check_kit import some_frames, stated

from phyradgs_cl.acquisition import ConeGeometry, Protocol, pixel_centres
from phyradgs_cl.api import static_scan
from phyradgs_cl.calibrate import AGREES, CANNOT_TELL, CORRECTED, calibrate
from phyradgs_cl.calibrate.search import Fallback, Search
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate

pytestmark = pytest.mark.slow

PITCH_MM = 0.125
TRUE_PX, STATED_PX, FAN_PITCH_MM = 28.0, 26.0, 0.56
BODY = EllipsoidPhantom(
    (
        Ellipsoid((0.0, 0.0, 0.0), (16.0, 14.0, 6.0), 0.012), Ellipsoid((9.0, 3.0, 1.0), (1.6,) * 3, 0.02),
        Ellipsoid((-4.0, 5.0, -1.0), (2.0,) * 3, 0.01), Ellipsoid((1.0, -3.0, 0.0), (1.2,) * 3, 0.03),
    ),
    "body",
)  # fmt: skip


@pytest.fixture(scope="module")
def half_turn(rt):
    """Makes a scan of 180 degrees whose panel is stated at an offset of so many pixels; the true one is 0."""
    geometry = ConeGeometry(500.0, 700.0, (8, 32), (PITCH_MM, PITCH_MM))
    scene = phantom_scene(rt, "foot", geometry, Grid.cube(16, 2.0), 16, "rows", 0)
    plan = Protocol(views=60, exposure_deg=6.0, readout_ratio=0.0)
    options = SimulationOptions(plan, noise="tigre", dose=1e5, time_samples=2)
    half = some_frames(simulate(scene.source, geometry, scene.grid, options), slice(30))
    return lambda pixels: stated(half, detector_offset_mm=(0.0, pixels * PITCH_MM))


def test_the_offset_of_half_a_turn_is_found_where_check_finds_it(rt, half_turn) -> None:
    for pixels, verdict in ((2.3, CORRECTED), (0.0, AGREES)):
        lines = []
        found = calibrate(half_turn(pixels), rt, "offset-u", note=lines.append)
        (offset,) = found.parameters
        assert offset.verdict == verdict, (pixels, offset)
        assert abs(offset.found) < 3 * offset.deviation < 0.5 * PITCH_MM
        assert abs(found.scan.geometry.detector_offset_mm[1]) < 0.2 * PITCH_MM
        assert found.alike == [] and lines[0].startswith("so far, 24 columns: offset-u ")
        before, after = found.residual_rms
        assert after < 0.5 * before if verdict == CORRECTED else after == before


def test_an_axis_beside_which_others_are_searched_stays_where_it_is(rt, half_turn) -> None:
    """The offset is held at its value while the roll steps, and the roll is then right."""
    found = {one.name: one for one in calibrate(half_turn(2.3), rt, "offset-u,roll").parameters}
    assert found["offset-u"].verdict == CORRECTED
    roll = found["roll"]
    assert roll.verdict in (AGREES, CANNOT_TELL)
    assert roll.found is None or abs(roll.found) < 3 * roll.deviation
    assert np.isfinite(roll.share)


def test_the_offset_is_no_shift_that_fits_better(rt) -> None:
    """A shift that leaves fewer rays measured twice always fits better: 27 pixels became 36 where 28 were true."""
    shape, pitch_mm = (16, 64), (1.1, FAN_PITCH_MM)
    true, stated = (ConeGeometry(150.0, 220.0, shape, pitch_mm, (0.0, px * FAN_PITCH_MM)) for px in (TRUE_PX, STATED_PX))
    angles_deg = 7.5 * np.arange(48)
    pose = true.pose(np.deg2rad(angles_deg))
    frames = BODY.line_integrals(pose[:, None, None, :3], pixel_centres(pose, shape))
    frames = frames + 0.002 * np.random.default_rng(0).standard_normal(frames.shape)
    (offset,) = calibrate(static_scan(frames.astype(np.float32), stated, angles_deg), rt, "offset-u").parameters
    assert offset.verdict == CORRECTED
    assert offset.found == pytest.approx(TRUE_PX * FAN_PITCH_MM, abs=0.2 * FAN_PITCH_MM)


def test_a_worse_fit_takes_back_all_but_what_is_held() -> None:
    known = Fallback(1.0, 0.01, is_significant=True)
    search = Search((), held=("offset-u",), fixed={"offset-u": known, "offset-v": known}, determined=("roll",))
    search.keep_held()
    assert search.corrections() == {"offset-u": 1.0}
    search.held = ()
    search.keep_held()
    assert search.corrections() == {}
