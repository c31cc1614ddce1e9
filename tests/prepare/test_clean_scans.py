"""The default steps on scans of 180 views: clean ones stay bit for bit, rings and single gains go."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import compare, prepare, reconstruct
from phyradgs_cl.prepare import DEFAULT_STEPS, PREPARED_KEY

pytestmark = pytest.mark.slow

CONE, PARALLEL = (5.0, 7.0), (500.0, 501.0)  # source to axis and to panel in mm
OBJECTS = ("head", "tube about the axis", "grains")


@pytest.mark.parametrize(("distances", "arc_deg"), [(CONE, 200.0), (PARALLEL, 360.0)], ids=["cone", "parallel"])
@pytest.mark.parametrize("name", OBJECTS)
def test_a_clean_scan_stays_bit_for_bit(rt, closed_form, name, distances, arc_deg) -> None:
    clean = closed_form(name, distances, arc_deg)
    prepared = prepare(clean, DEFAULT_STEPS, device=rt)
    np.testing.assert_array_equal(prepared.projections, clean.projections)
    assert prepared.valid.all() and prepared.provenance[PREPARED_KEY][-1]["result"] == "nothing to do"


@pytest.mark.parametrize(("name", "share", "rings"), [("grains", 0.75, 0.01), ("head", 0.65, 0.01), ("head", 0.65, 0.05)])
def test_most_of_what_rings_cost_comes_back(rt, closed_form, name, share, rings) -> None:
    """Three quarters, and less where 48 columns hold an object with many edges about the axis."""

    def psnr_db(scan: Scan) -> float:
        return float(compare(reconstruct(scan, "fdk", device=rt).volume, scan.reference)["psnr_db"])

    ringed = closed_form(name, CONE, rings=rings)
    clean_db, ringed_db = psnr_db(closed_form(name, CONE)), psnr_db(ringed)
    prepared = prepare(ringed, DEFAULT_STEPS, device=rt)
    assert ringed_db < clean_db - 0.2
    assert psnr_db(prepared) - ringed_db > share * (clean_db - ringed_db), (clean_db, ringed_db, psnr_db(prepared))
    assert prepared.provenance[PREPARED_KEY][-1]["spread"] == pytest.approx(rings, rel=0.15)


def _spoilt(clean: Scan, rows: slice, columns: slice, gain: float) -> Scan:
    frames = clean.projections.copy()
    frames[:, rows, columns] -= np.float32(np.log(gain))
    return replace(clean, projections=frames)


@pytest.mark.parametrize(
    ("name", "rows", "columns", "gain", "words"),
    [
        ("head", slice(None), slice(8, 9), 1.01, "1 column, gain off by 1.0 %"),
        ("tube about the axis", slice(None), slice(31, 32), 1.03, "1 column, gain off by 3.0 %"),
        ("grains", slice(20, 23), slice(5, 8), 1.05, "9 pixels, gain off by 5."),
    ],
)
def test_a_single_gain_is_regained_and_nothing_else_changes(rt, closed_form, name, rows, columns, gain, words) -> None:
    clean = closed_form(name, CONE)
    prepared = prepare(_spoilt(clean, rows, columns, gain), "rings", device=rt)
    left = np.abs((prepared.projections - clean.projections).mean(axis=0))
    assert left[rows, columns].mean() < 0.2 * np.log(gain)
    left[rows, columns] = 0
    assert not left.any()
    assert prepared.provenance[PREPARED_KEY][-1]["single"].startswith(words)


def test_what_mirrors_itself_or_stands_at_the_axis_is_the_objects(rt, closed_form) -> None:
    """A line at both sides of the axis, and one beside the axis, could be the object's: they stay."""
    clean = closed_form("head", CONE)
    both = _spoilt(_spoilt(clean, slice(None), slice(8, 9), 1.03), slice(None), slice(39, 40), 1.03)
    for scan in (both, _spoilt(clean, slice(None), slice(24, 25), 1.03)):
        np.testing.assert_array_equal(prepare(scan, "rings", device=rt).projections, scan.projections)


def test_a_gap_that_moves_on_is_no_spark(rt, closed_form) -> None:
    """A bright pixel that the frames before and after show too is the object's; in a single frame it is a spark."""
    clean = closed_form("head", CONE)
    frames = clean.projections.copy()
    for f in range(60, 120):
        frames[f, 24, 20 + f // 30] -= 0.25
    moving = replace(clean, projections=frames.copy())
    frames[30, 24, 24] -= 0.25
    both = prepare(replace(clean, projections=frames), "sparks", device=rt)
    assert prepare(moving, "sparks", device=rt).valid[61:119].all()
    assert not both.valid[30, 24, 24] and both.valid[30].sum() == 48**2 - 1
