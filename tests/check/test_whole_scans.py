"""Wrong sizes, units, orders and mirrored images of whole scans are named, and nothing else is blamed."""

from dataclasses import replace

import numpy as np
import pytest
from check_kit import cone_scan, negative, stated, suspected, verdicts
from parallel_kit import BODIES

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry
from phyradgs_cl.acquisition.geometry import default_grid
from phyradgs_cl.check import CANNOT_TELL, OK, SUSPICIOUS, check, consistency
from phyradgs_cl.check.coverage import check_coverage
from phyradgs_cl.check.orbit import find_orbit
from phyradgs_cl.check.run import quick_scan
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", params=[0.0, 0.375])
def aside(request, scan_of):
    """A scan whose panel stands in its place, and one whose panel stands three pixels beside it, as stated."""
    geometry = ConeGeometry(5.0, 7.0, (32, 32), (0.125, 0.125), (0.0, request.param))
    return scan_of(geometry, views=15, exposure_deg=24.0, is_fly=False)


def imported(scan, change=None, **geometry):
    """Changed frames with another geometry stated, and the grid that an import makes of it."""
    scan = scan if change is None else replace(scan, projections=np.ascontiguousarray(change(scan.projections)))
    scan = stated(scan, **geometry)
    return replace(scan, grid=default_grid(scan.geometry))


def only_alarm(found):
    """The only suspicious answer; the offset is then no matter."""
    assert len(found.suspicious) == 1, found.suspicious
    assert verdicts(found)["centre of rotation"] == CANNOT_TELL
    assert not found.is_consistent and np.isnan(found.offset_mm)
    return f"{found.suspicious[0].text} -> {found.suspicious[0].advice}"


def test_a_panel_far_beside_the_axis_raises_no_false_alarm(rt, scan_of) -> None:
    """A derived grid is wider than the panel; the object once fitted better with pixels twice as large, in finer voxels."""
    far = ConeGeometry(5.0, 7.0, (32, 32), (0.125, 0.125), (0.0, 1.2))
    assert suspected(check(imported(scan_of(far, views=15, exposure_deg=24.0, is_fly=False)), rt)) == []


def test_few_views_of_a_panel_far_beside_the_axis_fit_other_angles_no_better(rt, scan_of) -> None:
    """In the grid of the panel's view half the step fitted, and the other sense with the axis off the panel."""
    far = ConeGeometry(5.0, 7.0, (32, 32), (0.125, 0.125), (0.0, 1.5))
    foot, jaw = (imported(scan_of(far, phantom, views=25, is_fly=False)) for phantom in ("foot", "jaw"))
    assert consistency.check_consistency(rt, quick_scan(foot), foot).finding.verdict == OK
    for scan, verdict in ((jaw, OK), (negative(jaw), SUSPICIOUS)):
        assert find_orbit(rt, quick_scan(scan), scan, True).sign.verdict == verdict


def test_sizes_and_distances_in_another_unit_are_no_offset(rt, aside) -> None:
    """With pixels ten times too small, the panel has its axis beside it, where frames fit under any geometry."""
    in_the_middle = aside.geometry.detector_offset_mm[1] == 0
    factor = 1000.0 if in_the_middle else 0.1
    said = only_alarm(check(imported(aside, pixel_size_mm=(factor * 0.125,) * 2), rt))
    assert f"pixel sizes {1 / factor:g} times as large" in said and ("they do not tell which" in said) == in_the_middle
    if not in_the_middle:
        far = {"source_to_axis_mm": 0.5, "source_to_detector_mm": 0.7}
        said = only_alarm(check(imported(aside, **far), rt))
        assert "distances 10 times as large" in said and "pixel sizes" in said


def test_sizes_in_another_unit_are_no_offset_where_the_fan_is_narrow(rt, scan_of) -> None:
    """The axis lies between two coarse pixels, where a rough fit of the right sizes is no better than that of the wrong."""
    pitch_mm = 0.0625
    narrow = ConeGeometry(25.0, 35.0, (64, 64), (pitch_mm, pitch_mm), (0.0, 2.6 * pitch_mm))
    scan = scan_of(narrow, views=15, exposure_deg=24.0, readout_ratio=0.5)
    wrong = imported(scan, pixel_size_mm=(pitch_mm / 1000,) * 2, detector_offset_mm=(0.0, 0.0))
    assert "pixel sizes 1000 times as large" in only_alarm(check(wrong, rt))


def test_mirrored_frames_are_named(rt, aside, clean) -> None:
    """A mirror in u turns the offset round, and that is no second finding."""
    in_the_middle = aside.geometry.detector_offset_mm[1] == 0
    said = only_alarm(check(imported(aside, lambda p: p[:, :, ::-1]), rt))
    assert "mirrored in u" in said and "--column-0" in said and ("look the same" in said) == in_the_middle
    if in_the_middle:
        found = check(imported(clean, lambda p: p[:, ::-1]), rt)
        assert set(suspected(found)) <= {"sign of readout"}


def test_a_grid_of_another_size_than_the_object(still) -> None:
    finding = check_coverage(stated(still, pixel_size_mm=(0.0125, 0.0125)))
    assert finding.verdict == SUSPICIOUS and "the grid 2 mm, and the panel sees 0.2" in finding.text


BLACK = "frame 7 is unlike all others"


@pytest.mark.parametrize(("change", "said"), [
    (lambda p: np.where(np.arange(15)[:, None, None] == 7, np.float32(10), p), BLACK),
    (lambda p: p[[*range(6), 5, *range(7, 15)]], "frame 6 is frame 5 recorded twice"),
    (lambda p: p[[0, 1, 2, 10, *range(4, 10), 3, *range(11, 15)]], "frames 3 and 10 (from 0) fit if"),
    (lambda p: p[np.random.default_rng(3).permutation(15)], "cause not found"),
])  # fmt: skip
def test_frames_that_do_not_fit_together_are_named(rt, still, change, said) -> None:
    """And nothing else is blamed: a black frame moves no panel."""
    found = check(replace(still, projections=change(still.projections)), rt)
    assert "consistency" in suspected(found) and len(found.suspicious) <= 1 + (said is BLACK)
    assert said in found.suspicious[-1].text and found.suspicious[-1].advice
    assert found.is_consistent == (said != "cause not found")
    assert ("orientation of the frames" in found.suspicious[-1].advice) == (said == "cause not found")


@pytest.mark.parametrize(("factor", "said"), [(np.pi / 180, "radians"), (0.972, "% larger")])
def test_a_step_of_the_angles_that_is_stated_wrong(rt, clean, factor, said) -> None:
    sweeps = clean.trajectory.kinematics
    scaled = replace(sweeps, angle_start_rad=factor * sweeps.angle_start_rad, angle_end_rad=factor * sweeps.angle_end_rad)
    found = check(replace(clean, trajectory=CircularOrbit(clean.geometry, scaled)), rt)
    finding = next(f for f in found.suspicious if f.question == "consistency")
    assert said in finding.text and "354" not in finding.text
    assert {f.question for f in found.suspicious} <= {"consistency", "angles"}


@pytest.mark.parametrize(("views", "step_deg", "at"), [(40, 9.0, 26), (24, -15.0, 7), (72, 10.0, 51), (90, 100.0, 33)])
@pytest.mark.parametrize("is_missing", [True, False])
def test_a_lost_or_doubled_frame_is_no_wrong_step(rt, views, step_deg, at, is_missing) -> None:
    """Nor is it where more views follow each other than are fitted, or where an order jumps."""
    angles_deg = np.arange(views + 1) * step_deg
    true_deg = np.delete(angles_deg, at) if is_missing else np.insert(angles_deg[:-2], at, angles_deg[at - 1])
    frames = cone_scan(BODIES, true_deg, 0.003).projections
    scan = replace(cone_scan(BODIES, angles_deg[:-1], 0.003), projections=frames)
    text = consistency.check_consistency(rt, quick_scan(scan), scan).finding.text
    kind, place = text.split(" near frame ")
    assert kind.endswith("a frame is missing" if is_missing else "a frame is there twice")
    assert abs(int(place.split(" ")[0]) - at) <= 2


@pytest.mark.parametrize(("order", "verdict"), [(None, CANNOT_TELL), (4, SUSPICIOUS)])
def test_noise_about_a_small_bead_raises_no_alarm_but_a_wrong_order_does(rt, order, verdict) -> None:
    bead = EllipsoidPhantom((Ellipsoid((-0.5, 0.3, 0.2), (0.11, 0.11, 0.11), 1.0),), "bead")
    scan = cone_scan(bead, np.arange(40) * 9.0, 0.012)
    frames = scan.projections if order is None else np.random.default_rng(order).permutation(scan.projections)
    scan = replace(scan, projections=frames)
    finding = consistency.check_consistency(rt, quick_scan(scan), scan).finding
    assert finding.verdict == verdict and finding.value > finding.threshold, finding


def test_counts_that_begin_again_at_zero(rt, still) -> None:
    counts = np.round(7e4 * np.exp(-still.projections)) % 65536
    wrapped = np.log(7e4 / np.maximum(counts, 0.5)).astype(np.float32)
    found = check(replace(still, projections=wrapped), rt)
    assert suspected(found) == ["saturation"] and "overflow" in found.suspicious[0].advice
    assert verdicts(found)["centre of rotation"] == CANNOT_TELL and not found.is_consistent


def test_an_object_that_looks_the_same_from_every_angle_raises_no_alarm(rt, still) -> None:
    """Noise that flats share is not independent from frame to frame, and a cylinder has nothing else to show."""
    u = (np.arange(32) - 15.5) * 0.125 * 5 / 7
    disc, rng = np.sqrt(np.maximum(0.7**2 - u**2, 0)) * np.ones((32, 1)), np.random.default_rng(5)
    p = disc + 0.01 * rng.normal(size=(32, 32)) + 0.01 * rng.normal(size=still.projections.shape)
    found = check(replace(still, projections=p.astype(np.float32)), rt)
    assert found.suspicious == [] and verdicts(found)["sign of rotation"] == CANNOT_TELL


@pytest.mark.parametrize(
    ("longer", "noise", "verdict"), [(1.02, 0.01, CANNOT_TELL), (1.1, 0.1, CANNOT_TELL), (1.5, 0.1, SUSPICIOUS)]
)
def test_views_that_differ_by_less_than_their_noise_tell_nothing_and_an_oblong_object_tells(
    rt, scan_of, longer, noise, verdict
) -> None:
    """A nearly round object was suspected with right frames. The oblong one has its frames in a wrong order."""
    body = EllipsoidPhantom((Ellipsoid((0, 0, 0), (0.6 * longer, 0.6, 0.6), 1.0),), "body")
    geometry = ConeGeometry(5.0, 7.0, (32, 32), (0.125, 0.125))
    scan, random = scan_of(geometry, body, views=15, exposure_deg=24.0, readout_ratio=0.5), np.random.default_rng(1)
    frames = scan.projections[random.permutation(15)] if verdict == SUSPICIOUS else scan.projections
    noisy = replace(scan, projections=(frames + noise * random.normal(size=frames.shape)).astype(np.float32))
    finding = consistency.check_consistency(rt, quick_scan(noisy), noisy).finding
    assert finding.verdict == verdict and finding.value > finding.threshold, finding
