"""Shifts and turns of single views, and a motion of the object: found where they show, left where they do not."""

import json

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, Protocol
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, perturb
from phyradgs_cl.api import simulate
from phyradgs_cl.calibrate import AGREES, CORRECTED, calibrate
from phyradgs_cl.calibrate.per_view import SPLINES, MotionParameters, WobbleParameters, estimate_views
from phyradgs_cl.calibrate.problem import PassCounter, Stage
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_scan
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom
from phyradgs_cl.simulation import SimulationOptions, phantom_scene
from phyradgs_cl.simulation import simulate as simulate_frames
from phyradgs_cl.workflow import load_scan

pytestmark = pytest.mark.slow

SILENT = PassCounter(lambda *progress: None, {})


def by_name(found):
    return {one.name: one for one in found.parameters}


def test_shifts_of_views_are_found_and_turns_too_small_for_these_voxels_left(rt, right) -> None:
    rng = np.random.default_rng(1)
    planted = WobbleParameters.of(right).without_gauges(np.array([0.0, 0.125, 0.125]) * rng.normal(size=(11, 3)))
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
    """With what was corrected in the answer, the picture and the report of a volume."""
    how = {"size": 24, "detector": 36, "views": 24, "exposure_deg": 5.0, "readout_ratio": 0.5, "noise": "tigre", "dose": 1e5}
    scan = simulate("foot", **how, device=rt)
    parameters = WobbleParameters.of(scan, 6)
    drawn = np.array([np.deg2rad(3.0), 0.1, 0.1]) * np.random.default_rng(1).normal(size=(6, 3))
    values = parameters.without_gauges(drawn)
    np.testing.assert_allclose(parameters.without_gauges(values), values, atol=1e-12)
    planted = parameters.basis @ values
    off = perturb(scan, GeometryCorrection(), parameters.views_of(-values))
    path, out, volume, page = (tmp_path / name for name in ("scan.h5", "out.h5", "volume.h5", "page.html"))
    write_scan(path, off)
    assert cli.run(["calibrate", str(path), "--what", "wobble", "--splines", "6", "-o", str(out), "--json"]) == 0
    views = json.loads(capsys.readouterr().out)["views"]
    assert list(views) == ["turn_deg", "shift_v_mm", "shift_u_mm"] and len(views["turn_deg"]) == 24
    by_splines = np.c_[np.deg2rad(views["turn_deg"]), views["shift_v_mm"], views["shift_u_mm"]]
    left, size = (np.sqrt(np.mean(values**2, axis=0)) for values in (by_splines - planted, planted))
    assert np.all(left < [0.4, 0.05, 0.05] * size), left / size
    assert load_scan(out).provenance["calibration"]["views"] == views
    assert cli.run(["reconstruct", str(out), "--method", "fdk", "-o", str(volume)]) == 0
    assert cli.run(["report", str(volume), "-o", str(page)]) == 0
    section = page.read_text(encoding="utf-8").split('id="calibration"')[1].split("</section>")[0]
    assert section.count("corrected</td>") == 3 and section.count("<svg") == 3


def test_a_wobble_does_not_pass_for_a_roll(rt, monkeypatch) -> None:
    """Asked together with what all views share, which is found beside it; found again, it is what is left, beside what had
    been found before."""
    how = {"size": 16, "detector": 24, "views": 12, "exposure_deg": 15.0, "noise": "tigre", "dose": 1e5}
    scan, course = simulate("jaw", **how, device=rt), np.cos(np.pi * np.linspace(0, 1, 12))
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

    def coarse(rt, scan, of, stages, correction, *more):
        asked.append(correction)
        return estimate_views(rt, scan, of, stages[:1], correction, *more)

    monkeypatch.setattr("phyradgs_cl.calibrate.run.estimate_views", coarse)
    again = calibrate(found.scan, rt, "roll,wobble", splines=6)
    assert by_name(again)["roll"].verdict == AGREES
    now = again.scan.provenance
    assert now["calibrated_before"] == [found.scan.provenance["calibration"]]
    assert [one["name"] for one in now["calibration"]["parameters"]] == list(by_name(again))
    assert asked == [GeometryCorrection()]  # nothing that all views share was off: they are not solved for again


def test_an_object_that_moves_is_followed_and_the_file_has_its_poses(cli, rt, right, tmp_path, capsys) -> None:
    """Frames that overlap in time are no hindrance: a motion is of time alone."""
    parameters, course = MotionParameters.of(right), np.zeros((SPLINES, 6))
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


def test_gauges_are_what_an_object_elsewhere_or_a_larger_one_looks_like(right) -> None:
    """Of a motion, and of a wobble, in which the panel's offset shows."""
    parameters, angle = MotionParameters.of(right), 2 * np.pi / 11 * np.arange(11)
    towards = np.linalg.lstsq(parameters.basis, np.stack([np.cos(angle), np.sin(angle)], -1), rcond=None)[0]
    gauges = np.tile(np.arange(6.0), (SPLINES, 1))
    gauges[:, 3:5] += towards
    np.testing.assert_allclose(parameters.without_gauges(gauges), 0, atol=1e-9)
    once = parameters.without_gauges(np.random.default_rng(0).normal(size=(SPLINES, 6)))
    np.testing.assert_allclose(parameters.without_gauges(once), once, atol=1e-12)
    views, offset = WobbleParameters.of(right), np.tile([0.0, 0.0, 0.2], (11, 1))
    gauges = np.stack([np.full(11, 0.1), np.full(11, 0.2), 0.3 * np.cos(angle) - 0.1 * np.sin(angle)], -1)
    np.testing.assert_allclose(views.without_gauges(gauges), 0, atol=1e-12)
    np.testing.assert_allclose(views.without_gauges(offset), offset, atol=1e-12)
