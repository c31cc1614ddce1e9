"""Planted errors are found, with deviations that cover them; what frames cannot tell is left; a right scan stays."""

import json
from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, Protocol
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, Sway, Views, perturb, without_drift
from phyradgs_cl.api import simulate
from phyradgs_cl.calibrate import AGREES, CANNOT_TELL, CORRECTED, Calibration, calibrate
from phyradgs_cl.calibrate.parameters import in_words
from phyradgs_cl.calibrate.per_view import SPLINES, MotionParameters, WobbleParameters
from phyradgs_cl.calibrate.problem import CoarseProblem
from phyradgs_cl.calibrate.reduced import Reduced
from phyradgs_cl.calibrate.search import Search
from phyradgs_cl.calibrate.stages import PassCounter, Stage
from phyradgs_cl.calibrate.views import estimate_views
from phyradgs_cl.detector.effects import lagged
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_scan
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.simulation import SimulationOptions, phantom_scene
from phyradgs_cl.simulation import simulate as simulate_frames
from phyradgs_cl.workflow import load_scan

OFFSET_MM, ROLL_DEG = 0.3, 0.8

SILENT = PassCounter(lambda *progress: None, {})


@pytest.fixture(scope="module")
def wrong(right):
    return perturb(right, GeometryCorrection(offset_u_mm=-OFFSET_MM, roll_rad=-np.deg2rad(ROLL_DEG)))


def by_name(found):
    return {one.name: one for one in found.parameters}


def test_offset_and_roll_are_found_in_a_file_of_which_all_else_stays(cli, right, wrong, tmp_path, capsys) -> None:
    path, out = tmp_path / "scan.h5", tmp_path / "out.h5"
    write_scan(path, wrong)
    words = ["calibrate", str(path), "--what", "offset,roll,readout,exposure", "-o", str(out), "--json"]
    assert cli.run(words) == 0
    streams = capsys.readouterr()
    assert "so far, 24 columns: offset-u " in streams.err
    facts = json.loads(streams.out)
    lines = {one["name"]: one for one in facts["parameters"]}
    for name, truth, most in (("offset-u", 0.0, 0.01), ("roll", ROLL_DEG, 0.1)):
        one = lines[name]
        assert one["verdict"] == CORRECTED and 0 < one["deviation"] < most, one
        assert abs(one["found"] - truth) < 3 * one["deviation"], one
    for name in ("offset-v", "readout", "exposure"):
        assert lines[name]["verdict"] == CANNOT_TELL and lines[name]["found"] is None, name
    assert any("readout" in words for words in facts["alike"])
    assert facts["residual_rms_after"] < 0.5 * facts["residual_rms_before"]
    read = load_scan(out)
    assert read.provenance["calibration"]["parameters"] == facts["parameters"]
    assert read.shutter == right.shutter and np.array_equal(read.projections, wrong.projections)
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")
    time_s = right.frame_start_s[4:5]
    np.testing.assert_allclose(read.trajectory.pose(4, time_s), right.trajectory.pose(4, time_s), atol=0.02)


def test_a_right_scan_stays_as_it_is(rt, right) -> None:
    found = calibrate(right, rt)
    assert {one.verdict for one in found.parameters} == {AGREES, CANNOT_TELL} and found.corrected == []
    assert found.scan.trajectory is right.trajectory and found.scan.geometry is right.geometry
    assert by_name(found)["offset-u"].share > 0.5 > by_name(found)["readout"].share
    assert found.residual_rms[0] == found.residual_rms[1]


@pytest.mark.parametrize("tilt, names", [(0.0, {"offset-u"}), (1.8, {"offset-u"}), (9.0, {"offset-u", "tilt-v"})])
def test_what_differs_by_less_than_three_deviations_is_not_corrected_along(tilt, names) -> None:
    """Signals of an offset and a tilt that resemble each other, the tilt off by so many of its deviations."""
    rng = np.random.default_rng(2)
    one, other, noise = (values / np.linalg.norm(values) for values in rng.normal(size=(3, 2000)))
    signals = np.array([one, 0.95 * one + 0.3 * other])
    noise -= noise @ np.linalg.pinv(signals) @ signals
    count = len(signals)
    problem = Reduced(("offset-u", "tilt-v"), np.ones(count), signals, np.ones(count), np.eye(count), 1e-2 * noise, 20, 1e-3)
    deviation = problem.deviations()
    wrong = np.array([40.0, tilt]) * deviation @ signals
    known = ("offset-u", "tilt-v")
    shares = dict(zip(known, problem.shares.tolist(), strict=True))
    off = replace(problem, residual=problem.residual + wrong)
    kept = Search([], determined=known, shares=shares, reduced=off).corrections()
    assert set(kept) == names
    alone = problem.only(tuple(sorted(names)))
    expected = replace(alone, residual=problem.residual + wrong).step()
    assert list(kept.values()) == pytest.approx(expected.tolist())


def test_a_panel_of_one_row_tells_its_offset_and_no_turn(rt, right, monkeypatch, caplog) -> None:
    """And what explains the frames worse than what is stated corrects nothing."""
    geometry = replace(right.geometry, detector_shape=(1, 32))
    row = replace(
        right,
        projections=right.projections[:, 16:17],
        geometry=geometry,
        trajectory=CircularOrbit(geometry, right.trajectory.kinematics),
        shutter=replace(right.shutter, readout_s=0.0),
    )
    found = by_name(calibrate(perturb(row, GeometryCorrection(offset_u_mm=-OFFSET_MM)), rt, "offset-u,roll,tilt-u"))
    assert abs(found["offset-u"].found) < 0.03 and found["offset-u"].verdict == CORRECTED
    assert {found[name].verdict for name in ("roll", "tilt-u")} == {CANNOT_TELL}
    monkeypatch.setattr("phyradgs_cl.calibrate.search.Search.corrections", lambda search: {"offset-u": OFFSET_MM})
    worse = calibrate(row, rt, "offset-u")
    assert by_name(worse)["offset-u"].verdict == CANNOT_TELL and worse.scan.geometry is row.geometry
    assert worse.residual_rms[0] == worse.residual_rms[1] and "beyond the panel" not in caplog.text
    cut = replace(row, projections=row.projections + np.float32(0.3))
    calibrate(cut, rt, "offset-u")
    assert "beyond the panel" in caplog.text


def test_a_second_turn_the_other_way_tells_readout_and_exposure(cli, right, turned, tmp_path, capsys, caplog) -> None:
    """Which one scan does not, and two that turn alike do not."""
    longer = GeometryCorrection(readout_s=0.08, exposure_s=0.15)
    for name, scan in (("on", right), ("back", turned(back=True))):
        write_scan(tmp_path / name, perturb(scan, GeometryCorrection(readout_s=-0.08, exposure_s=-0.15)))
    words = ["calibrate", str(tmp_path / "on"), "--what", "readout,exposure", "--with"]
    assert cli.run([*words, str(tmp_path / "back"), "--json"]) == 0
    for one in json.loads(capsys.readouterr().out)["parameters"]:
        truth = one["stated"] + getattr(longer, one["name"] + "_s")
        assert one["verdict"] == CORRECTED and abs(one["found"] - truth) < 3 * one["deviation"], one
        assert one["deviation"] < 0.05, one
    assert cli.run([*words, str(tmp_path / "on")]) == 0
    said = capsys.readouterr().out
    assert said.count(CANNOT_TELL) == 2 and "±" not in said
    assert "turns as the first scan does" in caplog.text


def test_blocks_mix_no_rows_that_are_read_at_other_times(rt, turned) -> None:
    """Smoothed across them, frames look like a readout too short by up to 5 %."""
    scan = turned()
    frames = np.zeros_like(scan.projections)
    frames[:, 10:12] = 1
    rolled = replace(scan, projections=frames)
    frozen = replace(rolled, shutter=replace(scan.shutter, readout_s=0.0))
    profile = {name: CoarseProblem.of(rt, False, [one], Stage(16, 0, 0)).measured.mean((0, 2)) for name, one in
               (("rolled", rolled), ("frozen", frozen))}  # fmt: skip
    np.testing.assert_allclose(profile["rolled"], np.arange(16) == 5, atol=1e-6)
    assert 0.2 < profile["frozen"][5] < 0.9 and profile["frozen"][4] > 0.05


def test_a_detector_that_adds_photons(rt, turned) -> None:
    scan = turned(model="intensity")
    (found,) = calibrate(perturb(scan, GeometryCorrection(offset_u_mm=-OFFSET_MM)), rt, "offset-u").parameters
    assert abs(found.found) < 3 * found.deviation < 0.03 and found.verdict == CORRECTED


def test_shifts_of_views_are_found_and_turns_too_small_for_these_voxels_left(rt, right) -> None:
    rng = np.random.default_rng(1)
    planted = WobbleParameters.of(right).without_gauges(np.array([0.0, 0.125, 0.125]) * rng.normal(size=(15, 3)))
    off = perturb(right, GeometryCorrection(), WobbleParameters.of(right).views_of(-planted))
    stages = [Stage(16, 30, 10), Stage(32, 30, 10)]
    found = estimate_views(rt, off, WobbleParameters.of(off), stages, GeometryCorrection(), SILENT)
    assert [one.verdict for one in found.table][1:] == [CORRECTED, CORRECTED]
    left_mm = found.views.shift_mm - planted[:, 1:]
    assert np.sqrt(np.mean(left_mm**2)) < 0.1 * np.sqrt(np.mean(planted[:, 1:] ** 2))


def test_turns_of_a_smooth_object_on_which_levels_differ_are_left(rt) -> None:
    """0.7° (RMS) that go round twice per turn: frames of two balls look the same, and what is found has the wrong sign."""
    balls = Ellipsoid((0, 0, 0), (0.83, 0.67, 0.75), 1.2), Ellipsoid((0.2, 0.2, -0.1), (0.25,) * 3, 2.4)
    geometry, grid = ConeGeometry(5.0, 7.0, (48, 48), (4.0 / 48,) * 2), Grid.cube(24, 2.0)
    plan = Protocol(views=40, exposure_deg=7.2, readout_ratio=0.2)
    scene = phantom_scene(rt, EllipsoidPhantom(balls, "balls"), geometry, grid, 24, "rows", 0)
    scan = simulate_frames(scene.source, geometry, scene.grid, SimulationOptions(plan, noise="beer", dose=1e5))
    planted = np.zeros((40, 3))
    planted[:, 0] = np.radians(np.sin(4 * np.pi * np.arange(40) / 40))
    wobbling = perturb(scan, GeometryCorrection(), WobbleParameters.of(scan).views_of(planted))
    stages = [Stage(24, 40, 15), Stage(48, 40, 12)]
    found = estimate_views(rt, wobbling, WobbleParameters.of(scan), stages, GeometryCorrection(), SILENT)
    turn = found.table[0]
    assert turn.verdict == AGREES and found.views is None, found.table


def test_a_slow_wobble_by_splines_of_time(cli, rt, tmp_path, capsys) -> None:
    """Better than view by view, with what was corrected in the answer, the picture and the report of a volume."""
    how = {"size": 24, "detector": 36, "views": 40, "exposure_deg": 3.0, "readout_ratio": 0.5, "noise": "tigre", "dose": 1e5}
    scan = simulate("foot", **how, device=rt)
    parameters = WobbleParameters.of(scan, 6)
    drawn = np.array([np.deg2rad(3.0), 0.1, 0.1]) * np.random.default_rng(1).normal(size=(6, 3))
    values = parameters.without_gauges(drawn)
    np.testing.assert_allclose(parameters.without_gauges(values), values, atol=1e-12)
    planted = parameters.basis @ values
    off = perturb(scan, GeometryCorrection(), parameters.views_of(-values))
    stages = [Stage(18, 40, 15), Stage(36, 40, 12)]
    by_view = estimate_views(rt, off, WobbleParameters.of(off), stages, GeometryCorrection(), SILENT).views
    path, out, volume, page = (tmp_path / name for name in ("scan.h5", "out.h5", "volume.h5", "page.html"))
    write_scan(path, off)
    assert cli.run(["calibrate", str(path), "--what", "wobble", "--splines", "6", "-o", str(out), "--json"]) == 0
    views = json.loads(capsys.readouterr().out)["views"]
    assert list(views) == ["turn_deg", "shift_v_mm", "shift_u_mm"] and len(views["turn_deg"]) == 40
    by_splines = np.c_[np.deg2rad(views["turn_deg"]), views["shift_v_mm"], views["shift_u_mm"]]
    left, size = (np.sqrt(np.mean(values**2, axis=-2)) for values in (
        np.stack([np.c_[by_view.turn_rad, by_view.shift_mm], by_splines]) - planted, planted))  # fmt: skip
    assert np.all(left[1] < [0.4, 0.05, 0.05] * size) and np.all(left[1] < 0.8 * left[0]), left / size
    assert load_scan(out).provenance["calibration"]["views"] == views
    assert cli.run(["reconstruct", str(out), "--method", "fdk", "-o", str(volume)]) == 0
    assert cli.run(["report", str(volume), "-o", str(page)]) == 0
    section = page.read_text(encoding="utf-8").split('id="calibration"')[1].split("</section>")[0]
    assert section.count("corrected</td>") == 3 and section.count("<svg") == 3


def test_a_wobble_does_not_pass_for_a_roll(rt, monkeypatch) -> None:
    """Asked together with what all views share, which is found beside it; found again, it is what is left, beside what had
    been found before."""
    how = {"size": 24, "detector": 36, "views": 30, "exposure_deg": 6.0, "noise": "tigre", "dose": 1e5}
    scan = simulate("jaw", **how, device=rt)
    course = np.cos(np.pi * np.linspace(0, 1, 30))
    parameters = WobbleParameters.of(scan)
    planted = parameters.without_gauges(np.stack([0 * course, 0.1 * course**2, 0.15 * course], -1))
    offset_mm = 0.2
    off = perturb(scan, GeometryCorrection(offset_u_mm=-offset_mm), parameters.views_of(-planted))
    found = calibrate(off, rt, "offset-u,roll,wobble", splines=6)
    lines = by_name(found)
    assert lines["roll"].verdict == AGREES and lines["offset-u"].verdict == CORRECTED
    assert abs(lines["offset-u"].found) < 0.02
    np.testing.assert_allclose(found.per_view()["shift_v_mm"], planted[:, 1], atol=0.01)
    asked: list[GeometryCorrection] = []
    counted = "phyradgs_cl.calibrate.run.estimate_views"

    def coarse(rt, scan, of, stages, correction, *more):
        asked.append(correction)
        return estimate_views(rt, scan, of, stages[:1], correction, *more)

    monkeypatch.setattr(counted, coarse)
    again = calibrate(found.scan, rt, "roll,wobble", splines=6)
    assert by_name(again)["roll"].verdict == AGREES
    now = again.scan.provenance
    assert now["calibrated_before"] == [found.scan.provenance["calibration"]]
    assert [one["name"] for one in now["calibration"]["parameters"]] == list(by_name(again))
    assert asked == [GeometryCorrection()]  # nothing that all views share was off: they are not solved for again


def test_a_figure_has_a_curve_for_each_number_of_a_view(right) -> None:
    images = np.zeros((15, 4, 5), np.float32)
    alone = Calibration(right, [], [], (1.0, 0.5), images, images)
    sway = Sway.none(right, 7)
    moving = replace(alone, views=replace(sway, coefficients=np.ones((7, 6))))
    shifted = replace(alone, views=Views(np.zeros(15), np.ones((15, 2))))
    left = replace(alone, views=Views(np.zeros(15), np.zeros((15, 2))))
    count = [len(found.plot().axes) for found in (alone, shifted, moving, left)]
    assert alone.per_view() == {} and alone.facts()["views"] == {}
    assert repr(alone) == "Calibration(; residual 1, then 0.5)"
    assert count[1] == count[0] + 1 and count[2] == count[0] + 2 and count[3] == count[0]  # a kind that is 0 was left alone
    assert list(shifted.per_view()) == ["shift_v_mm", "shift_u_mm"]
    last = moving.plot().axes[-1]
    assert [line.get_label() for line in last.get_lines()] == ["shift x", "shift y", "shift z"]


def test_an_object_that_moves_is_followed_and_the_file_has_its_poses(cli, rt, right, tmp_path, capsys) -> None:
    """Frames that overlap in time are no hindrance: a motion is of time alone."""
    parameters = MotionParameters.of(right)
    course = np.zeros((SPLINES, 6))
    course[:, 3:] = 0.15 * np.random.default_rng(2).normal(size=(SPLINES, 3))
    planted = parameters.without_gauges(course)
    path, out = tmp_path / "scan.h5", tmp_path / "out.h5"
    write_scan(path, perturb(right, GeometryCorrection(), parameters.views_of(-planted)))
    assert cli.run(["calibrate", str(path), "--what", "motion", "-o", str(out), "--json"]) == 0
    lines = {one["name"]: one for one in json.loads(capsys.readouterr().out)["parameters"]}
    sizes_mm = np.std(parameters.basis @ planted, 0)
    for kind, axis in enumerate("xyz"):
        one = lines[f"shift along {axis} of the object"]
        assert one["verdict"] == CORRECTED and one["unit"] == "mm"
        assert one["found"] == pytest.approx(sizes_mm[3 + kind], rel=0.2)
    times_s = right.frame_start_s + right.shutter.middle_s
    truth, stated, found = (
        np.array([scan.trajectory.pose(f, t) for f, t in enumerate(times_s)])
        for scan in (right, load_scan(path), load_scan(out))
    )
    assert np.std((found - truth)[:, :3]) < 0.25 * np.std((stated - truth)[:, :3])


def test_a_still_object_stays_still(rt, right) -> None:
    stages = [Stage(16, 30, 10), Stage(32, 30, 10)]
    found = estimate_views(rt, right, MotionParameters.of(right), stages, GeometryCorrection(), SILENT)
    shifts_mm = np.zeros(1) if found.views is None else found.views.coefficients[:, 3:]
    assert np.abs(shifts_mm).max() < 0.02


def test_gauges_of_a_motion_are_an_object_elsewhere_and_a_larger_one(right) -> None:
    parameters = MotionParameters.of(right)
    angle = np.deg2rad(24 * np.arange(15))
    towards = np.linalg.lstsq(parameters.basis, np.stack([np.cos(angle), np.sin(angle)], -1), rcond=None)[0]
    gauges = np.tile(np.arange(6.0), (SPLINES, 1))
    gauges[:, 3:5] += towards
    np.testing.assert_allclose(parameters.without_gauges(gauges), 0, atol=1e-9)
    once = parameters.without_gauges(np.random.default_rng(0).normal(size=(SPLINES, 6)))
    np.testing.assert_allclose(parameters.without_gauges(once), once, atol=1e-12)


def test_gauges_of_views_are_what_another_object_looks_like(right) -> None:
    angle = np.deg2rad(24 * np.arange(15))
    gauges = np.stack([np.full(15, 0.1), np.full(15, 0.2), 0.3 * np.cos(angle) - 0.1 * np.sin(angle)], -1)
    np.testing.assert_allclose(WobbleParameters.of(right).without_gauges(gauges), 0, atol=1e-12)
    offset = np.zeros((15, 3))
    offset[:, 2] = 0.2  # the panel's, which shows
    np.testing.assert_allclose(WobbleParameters.of(right).without_gauges(offset), offset, atol=1e-12)


def test_a_combination_in_words() -> None:
    said = in_words({"readout": 0.2, "exposure": -0.9, "start": 0.8, "roll": 0.01})
    assert said == "exposure against start: looks like an object turned about the axis, and smoother or sharper"


def few(scan):
    return replace(scan, projections=scan.projections[:5], frame_start_s=scan.frame_start_s[:5])


@pytest.mark.parametrize(
    ("what", "change", "others", "said"),
    [
        ("rol", lambda s: s, (), "did you mean 'roll'?"),
        ("", lambda s: s, (), "--what: found ''"),
        ("readout", lambda s: replace(s, is_fly=False), (), "stands still"),
        ("roll", few, (), "found 5 frames"),
        ("wobble", lambda s: s, (lambda s: s,), "one scan"),
        ("motion", lambda s: s, (lambda s: s,), "one scan"),
        ("wobble,motion", lambda s: s, (), "one of the two"),
        ("roll", lambda s: s, (lambda s: perturb(s, GeometryCorrection(offset_u_mm=1.0)),), "--with: geometry"),
    ],
)
def test_what_cannot_be_asked_is_refused(rt, right, what, change, others, said) -> None:
    with pytest.raises(InputError) as refused:
        calibrate(change(right), rt, what, [other(right) for other in others])
    assert said in str(refused.value)


def test_splines_are_of_a_wobble(rt, right) -> None:
    for what, splines, said in (("roll", 6, "with --what wobble"), ("wobble", 3, "from 4"), ("wobble", 16, "to 15")):
        with pytest.raises(InputError, match=f"--splines: found {splines}; expected .*{said}"):
            calibrate(right, rt, what, splines=splines)


def test_views_of_frames_that_overlap_have_no_place_in_a_file(refused, right, tmp_path) -> None:
    path = tmp_path / "scan.h5"
    write_scan(path, replace(right, shutter=replace(right.shutter, readout_s=1.5)))
    refused(["calibrate", path, "--what", "wobble", "-o", tmp_path / "out.h5"], "do not overlap in time")
    refused(["calibrate", path, "--what", "offset, drift", "-o", tmp_path / "out.h5"], "prepare --steps air")
    refused(["calibrate", path, "-o", path], "the input file")
    refused(["calibrate", path, "-o", tmp_path / "out.png"], "the suffix .png of another format")
    for picture in ("out.h5", "out.jpg", "out"):
        refused(["calibrate", path, "-o", tmp_path / "out.h5", "--picture", tmp_path / picture], "ends in .png")
    assert not (tmp_path / "out.h5").exists()


def test_the_end_that_is_read_first_is_told_where_it_bends_the_object(cli, turned, tmp_path, capsys) -> None:
    """Columns bend it; rows twist it, which two turns tell and one does not."""
    words = ["--what", "direction", "--json"]
    for name, scan in (("on", turned()), ("back", turned(back=True)), ("columns", turned(axis="columns"))):
        write_scan(tmp_path / name, replace(scan, shutter=replace(scan.shutter, direction=-1)))
    on, out = tmp_path / "on", tmp_path / "out.h5"
    back, columns = ["--with", tmp_path / "back"], [tmp_path / "columns"]
    for asked, verdict in (([on], CANNOT_TELL), ([on, *back], CORRECTED), (columns, CORRECTED)):
        assert cli.run([*map(str, ["calibrate", *asked, "-o", out]), *words]) == 0
        (one,) = json.loads(capsys.readouterr().out)["parameters"]
        assert one["verdict"] == verdict, (asked, one)
        assert load_scan(out).shutter.direction == (1 if verdict == CORRECTED else -1)
        assert one["found"] is None if verdict == CANNOT_TELL else 0 < one["deviation"] <= 0.5


def test_lag_and_drift_are_numbers_of_the_frames(rt, right) -> None:
    """A panel with 5 % of lag of which 1 % is stated, and a beam that gets 4 % (log) brighter; neither."""
    brighter = (right.projections - 0.04 * np.linspace(-0.5, 0.5, right.frames)[:, None, None]).astype(np.float32)
    off = replace(right, projections=lagged(brighter, 0.05).astype(np.float32), lag=0.01)
    found = calibrate(off, rt, "lag,drift,offset-u")
    lines = by_name(found)
    assert lines["lag"].stated == pytest.approx(1) and lines["offset-u"].verdict == AGREES
    for one, truth in ((lines["lag"], 5), (lines["drift"], 4)):
        assert one.verdict == CORRECTED and abs(one.found - truth) < 3 * one.deviation < 3, one
    assert found.scan.lag == pytest.approx(lines["lag"].found / 100)
    assert np.abs(found.scan.projections - without_drift(off, 0.04).projections).max() < 0.01
    for one in calibrate(right, rt, "lag,drift").parameters:
        assert one.verdict == AGREES and abs(one.found) < 3 * one.deviation, one


def test_the_readout_of_a_global_shutter_is_refused(rt) -> None:
    """A step below 0 had ended the run with an error about a value that nobody had given."""
    scan = simulate("foot", size=8, detector=16, readout_ratio=0.0, device=rt)
    for what in ("readout", "timing", "direction"):
        with pytest.raises(InputError) as refused:
            calibrate(scan, rt, what)
        assert refused.value.found == "a readout of 0 s", what
