"""Half a turn of nearly parallel rays: too little of an offset's signal is its own, but the best axis is known."""

import numpy as np
import pytest
from check_kit import some_frames, stated

from phyradgs_cl.acquisition import ConeGeometry, Protocol
from phyradgs_cl.calibrate import AGREES, CANNOT_TELL, CORRECTED, calibrate
from phyradgs_cl.calibrate.parameters import PARAMETERS
from phyradgs_cl.calibrate.problem import CoarseProblem, Stage
from phyradgs_cl.calibrate.search import LEAST_SHARE, Fallback, Search
from phyradgs_cl.fields import Grid
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate

pytestmark = pytest.mark.slow

PITCH_MM = 0.125


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
    for pixels, verdict in ((2.3, CORRECTED), (-1.5, CORRECTED), (0.0, AGREES)):
        lines = []
        found = calibrate(half_turn(pixels), rt, "offset-u", note=lines.append)
        (offset,) = found.parameters
        assert offset.verdict == verdict, (pixels, offset)
        assert abs(offset.found) < 3 * offset.deviation < 0.5 * PITCH_MM
        assert abs(found.scan.geometry.detector_offset_mm[1]) < 0.2 * PITCH_MM
        assert found.alike == [] and lines[0].startswith("so far, 24 columns: offset-u ")
        before, after = found.residual_rms
        assert after < 0.5 * before if verdict == CORRECTED else after == before


def test_what_only_the_axis_tells_is_not_said_to_be_undetermined(rt, half_turn) -> None:
    """Without an answer from the axis the frames do not determine the offset."""
    scan, stage = half_turn(0.0), Stage(16, first=20, again=10, steps=1)
    problem = CoarseProblem.of(rt, [scan], stage)
    alone = Search([PARAMETERS["offset-u"]])
    alone.descend(problem, stage)
    assert alone.determined == () and alone.shares["offset-u"] < 2 * LEAST_SHARE
    assert alone.alike == ["offset-u: looks like an object beside the axis"]
    assert alone.table(scan, {})[0].verdict == CANNOT_TELL
    for fallback, verdict in ((Fallback(0.3, 0.01, True), CORRECTED), (Fallback(0.001, 0.01, False), AGREES)):
        helped = Search([PARAMETERS["offset-u"]], fallback={"offset-u": fallback})
        helped.descend(problem, stage)
        corrections = helped.corrections()
        assert corrections == ({"offset-u": 0.3} if verdict == CORRECTED else {}) and helped.alike == []
        (offset,) = helped.table(scan, corrections)
        assert (offset.verdict, offset.deviation) == (verdict, 0.01)
        assert offset.found == pytest.approx(fallback.value)


def test_an_axis_beside_which_others_are_searched_stays_where_it_is(rt, half_turn) -> None:
    """The offset is held at its value while the roll steps, and the roll is then right."""
    found = {one.name: one for one in calibrate(half_turn(2.3), rt, "offset-u,roll").parameters}
    assert found["offset-u"].verdict == CORRECTED
    roll = found["roll"]
    assert roll.verdict in (AGREES, CANNOT_TELL)
    assert roll.found is None or abs(roll.found) < 3 * roll.deviation
    assert np.isfinite(roll.share)
