"""Planted errors are found, with deviations that cover them; what frames cannot tell is left; a right scan stays."""

import json
from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, EncoderTable
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, perturb
from phyradgs_cl.api import simulate
from phyradgs_cl.calibrate import AGREES, CANNOT_TELL, CORRECTED, calibrate
from phyradgs_cl.calibrate.parameters import PARAMETERS
from phyradgs_cl.calibrate.problem import CoarseProblem, Stage
from phyradgs_cl.calibrate.run import STAGES
from phyradgs_cl.calibrate.search import Reduced, Search
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import write_scan
from phyradgs_cl.removed import REMOVED
from phyradgs_cl.workflow import load_scan

pytestmark = pytest.mark.slow

OFFSET_MM, ROLL_DEG = 0.3, 0.8


def by_name(found):
    return {one.name: one for one in found.parameters}


@pytest.fixture
def one_grid(monkeypatch):
    """For what the first grid shows as well as the second."""
    monkeypatch.setattr("phyradgs_cl.calibrate.run.STAGES", STAGES[:1])


def test_offset_and_roll_are_found_in_a_file_of_which_all_else_stays(cli, right, tmp_path, capsys) -> None:
    wrong = perturb(right, GeometryCorrection(offset_u_mm=-OFFSET_MM, roll_rad=-np.deg2rad(ROLL_DEG)))
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


def test_frames_may_be_longer_than_the_encoder_table_of_the_stated_ones(rt, right, one_grid) -> None:
    time_s = np.array([right.frame_start_s[0], right.frame_start_s[-1] + right.shutter.span_s])
    angle_rad = np.concatenate([right.trajectory.angle_rad(f, time_s[[end]]) for f, end in ((0, 0), (right.frames - 1, 1))])
    tight = CircularOrbit(right.geometry, EncoderTable(time_s, np.unwrap(angle_rad)))
    stated = replace(right, shutter=replace(right.shutter, exposure_s=0.5 * right.shutter.exposure_s))
    found = calibrate(replace(stated, trajectory=tight), rt, "timing")
    assert all(one.verdict in (AGREES, CANNOT_TELL, CORRECTED) for one in found.parameters)
    found.scan.check_timing()


def test_a_right_scan_stays_as_it_is(rt, right) -> None:
    found = calibrate(right, rt)
    assert {one.verdict for one in found.parameters} == {AGREES, CANNOT_TELL} and found.corrected == []
    assert found.scan.trajectory is right.trajectory and found.scan.geometry is right.geometry
    assert by_name(found)["offset-u"].share > 0.5 > by_name(found)["readout"].share
    assert found.residual_rms[0] == found.residual_rms[1] and "tilt-v " in repr(found)


def test_a_thin_object_leaves_open_what_voxels_follow_badly(rt) -> None:
    """Coarse voxels do not follow a foot that is lifted: what remains of offset-v and tilt-u is their error."""
    scan = simulate("foot", size=24, detector=32, views=15, exposure_deg=12.0, noise="tigre", dose=28_000, device=rt)
    verdicts = {name: one.verdict for name, one in by_name(calibrate(scan, rt, "offset,tilt")).items()}
    assert verdicts == {"offset-u": AGREES, "offset-v": CANNOT_TELL, "tilt-v": AGREES, "tilt-u": CANNOT_TELL}


@pytest.mark.parametrize(("tilt", "names"), [
    (0.0, ["offset-u"]), (0.6, ["offset-u"]), (-1.3, ["offset-u"]), (1.8, ["offset-u", "tilt-v"]),
    (-2.7, ["offset-u", "tilt-v"]), (9.0, ["offset-u", "tilt-v"]),
])  # fmt: skip
def test_a_value_returns_to_what_is_stated_where_that_moves_no_other(right, tilt, names) -> None:
    """Signals of an offset and a tilt that resemble each other, the tilt off by so many of its deviations."""
    rng = np.random.default_rng(2)
    one, other, noise = (values / np.linalg.norm(values) for values in rng.normal(size=(3, 2000)))
    signals = np.array([one, 0.95 * one + 0.3 * other])
    noise -= noise @ np.linalg.pinv(signals) @ signals
    problem = Reduced(("offset-u", "tilt-v"), np.ones(2), signals, np.ones(2), np.eye(2), 1e-2 * noise, 20, 1e-3)
    deviation = problem.deviations()
    wrong = np.array([40.0, tilt]) * deviation
    known, shares = problem.names, dict(zip(problem.names, problem.shares.tolist(), strict=True))
    off = replace(problem, residual=problem.residual + wrong @ signals)
    search = Search([PARAMETERS["offset-u"]], determined=known, shares=shares, reduced=off)
    kept = search.corrections()
    assert list(kept) == names and list(kept.values()) == pytest.approx(off.only(names).step().tolist())
    (offset,) = search.table(right, kept)
    moved = kept["offset-u"] - wrong[0]
    assert abs(moved) < 1.42 * deviation[0] and offset.deviation == pytest.approx(np.hypot(deviation[0], moved))
    assert bool(abs(moved) > 0.5 * deviation[0]) == (tilt in (0.6, -1.3))


def test_a_panel_of_one_row_tells_its_offset_and_no_turn(rt, right, one_grid, monkeypatch, caplog) -> None:
    """And what explains the frames worse than what is stated corrects nothing."""
    geometry = replace(right.geometry, detector_shape=(1, 32))
    orbit, shutter = CircularOrbit(geometry, right.trajectory.kinematics), replace(right.shutter, readout_s=0.0)
    row = replace(right, projections=right.projections[:, 16:17], geometry=geometry, trajectory=orbit, shutter=shutter)
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


def test_a_second_turn_the_other_way_tells_readout_exposure_and_the_end_read_first(
    cli, right, turned, tmp_path, capsys, caplog
) -> None:
    """Which one scan does not, and two that turn alike do not. Rows twist the object; columns bend it, and tell the end."""
    longer, name_of = GeometryCorrection(readout_s=0.08, exposure_s=0.15), str(tmp_path / "{}").format
    stated = GeometryCorrection(readout_s=-0.08, exposure_s=-0.15)
    scans = {"on": perturb(right, stated), "back": perturb(turned(back=True), stated), "columns": turned(axis="columns")}
    for name, scan in scans.items():
        write_scan(name_of(name), replace(scan, shutter=replace(scan.shutter, direction=-1)))
    on, back, columns, out = map(name_of, (*scans, "out.h5"))
    for asked, what, verdict in (
        ([on, "--with", back], "direction,readout,exposure", CORRECTED),
        ([on, "--with", on], "direction,readout,exposure", CANNOT_TELL), ([columns], "direction", CORRECTED),
    ):  # fmt: skip
        assert cli.run(["calibrate", *asked, "--what", what, "-o", out, "--json"]) == 0
        for one in json.loads(capsys.readouterr().out)["parameters"]:
            assert one["verdict"] == verdict, (asked, one)
            if verdict == CANNOT_TELL:
                assert one["found"] is None
            elif one["name"] == "direction":
                assert 0 < one["deviation"] <= 0.5
            else:
                truth = one["stated"] + getattr(longer, one["name"] + "_s")
                assert abs(one["found"] - truth) < 3 * one["deviation"] < 0.15, one
        assert load_scan(out).shutter.direction == (1 if verdict == CORRECTED else -1)
    assert "turns as the first scan does" in caplog.text


def test_blocks_mix_no_rows_that_are_read_at_other_times(rt, turned) -> None:
    """Smoothed across them, frames look like a readout too short by up to 5 %."""
    scan = turned()
    frames = np.zeros_like(scan.projections)
    frames[:, 10:12] = 1
    rolled = replace(scan, projections=frames)
    frozen = replace(rolled, shutter=replace(scan.shutter, readout_s=0.0))
    profile = {name: CoarseProblem.of(rt, [one], Stage(16, 0, 0)).measured.mean((0, 2)) for name, one in
               (("rolled", rolled), ("frozen", frozen))}  # fmt: skip
    np.testing.assert_allclose(profile["rolled"], np.arange(16) == 5, atol=1e-6)
    assert 0.2 < profile["frozen"][5] < 0.9 and profile["frozen"][4] > 0.05


def test_a_detector_that_adds_photons(rt, turned, one_grid) -> None:
    scan = turned(model="intensity")
    (found,) = calibrate(perturb(scan, GeometryCorrection(offset_u_mm=-OFFSET_MM)), rt, "offset-u").parameters
    assert abs(found.found) < 3 * found.deviation < 0.03 and found.verdict == CORRECTED


def test_what_cannot_be_asked_is_refused(rt, right) -> None:
    """A step of a readout below 0 had ended the run with an error about a value that nobody had given."""
    few = replace(right, projections=right.projections[:5], frame_start_s=right.frame_start_s[:5])
    at_once = replace(right, shutter=replace(right.shutter, readout_s=0.0))
    moved = perturb(right, GeometryCorrection(offset_u_mm=1.0))
    for scan, what, others, said in (
        (right, "rol", [], "did you mean 'roll'?"), (right, "", [], "--what: found ''"), (few, "roll", [], "found 5 frames"),
        (replace(right, is_fly=False), "readout", [], "stands still"), (right, "wobble,motion", [], "one of the two"),
        (right, "wobble", [right], "one scan"), (right, "roll", [moved], "--with: geometry"),
        *((at_once, what, [], "found a readout of 0 s") for what in ("readout", "timing", "direction")),
    ):  # fmt: skip
        with pytest.raises(InputError) as refused:
            calibrate(scan, rt, what, others)
        assert said in str(refused.value), what


def test_views_of_frames_that_overlap_have_no_place_in_a_file(refused, right, tmp_path) -> None:
    path = tmp_path / "scan.h5"
    write_scan(path, replace(right, shutter=replace(right.shutter, readout_s=1.5)))
    refused(["calibrate", path, "--what", "wobble", "-o", tmp_path / "out.h5"], "do not overlap in time")
    refused(["calibrate", path, "--what", "offset, drift", "-o", tmp_path / "out.h5"], REMOVED["--what drift"])
    refused(["calibrate", path, "-o", path], "reads or writes")
    refused(["calibrate", path, "-o", tmp_path / "out.png"], "the suffix .png of another format")
    refused(["calibrate", path, "-o", tmp_path / "out.h5", "--picture", tmp_path / "out.jpg"], "ends in .png")
    assert not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize(("what", "protocol"), [("offset-u,direction", "rapid"), ("wobble", "static")])
def test_a_calibration_ends_where_it_said_that_it_would(rt, what, protocol) -> None:
    """Every pass is counted, none twice, and there were no more than planned."""
    scan, told = simulate("foot", size=12, detector=16, views=12, protocol=protocol, device=rt), []
    calibrate(scan, rt, what, report=lambda *report: told.append(report))
    done, totals, words, shares = zip(*told, strict=True)
    assert list(done) == sorted(done) and list(shares) == sorted(shares) and done[-1] > 20
    assert done[-1] == totals[-1] <= totals[0] and shares[-1] == pytest.approx(1.0)
    assert words[0] == "where the axis is" and words[-1] == "residuals"
