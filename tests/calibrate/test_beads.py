"""A phantom of known shape: its frames by two routes, where it lies, and what it tells of a scanner."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition import ConeGeometry, Protocol
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, perturb
from phyradgs_cl.calibrate import CORRECTED, calibrate
from phyradgs_cl.calibrate.beads import BeadProblem
from phyradgs_cl.calibrate.placing import placements
from phyradgs_cl.calibrate.problem import Stage
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers import load_beads
from phyradgs_cl.io import write_scan
from phyradgs_cl.phantoms import Cylinder, Ellipsoid, EllipsoidPhantom
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate
from phyradgs_cl.workflow import load_scan

BEADS = """
title = "seven beads and a wire"
attenuation_per_mm = 5.0
bead = [
    {centre_mm = [0.5, 0.1, 0.4], radius_mm = 0.1}, {centre_mm = [-0.3, 0.5, 0.1], radius_mm = 0.08},
    {centre_mm = [-0.4, -0.4, 0.6], radius_mm = 0.1}, {centre_mm = [0.2, -0.6, -0.1], radius_mm = 0.1},
    {centre_mm = [0.55, -0.35, -0.55], radius_mm = 0.08}, {centre_mm = [-0.5, 0.2, -0.6], radius_mm = 0.1},
    {centre_mm = [0.0, 0.1, -0.2], radius_mm = 0.1},
]

[[wire]]
from_mm = [-0.1, 0.6, -0.7]
to_mm = [0.1, -0.2, 0.7]
radius_mm = 0.05
attenuation_per_mm = 3.0
"""
LYING = np.array([0.05, -0.08, 0.6, 0.04, -0.05, 0.03])


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("beads") / "beads.toml"
    path.write_text(BEADS)
    return path


@pytest.fixture(scope="module")
def known(file) -> EllipsoidPhantom:
    return load_beads(file)


def lying(phantom: EllipsoidPhantom, place=LYING) -> EllipsoidPhantom:
    def move(point):
        return tuple((Rotation.from_rotvec(place[:3]).apply(point) + place[3:]).tolist())

    def body(one):
        if isinstance(one, Cylinder):
            return replace(one, ends_mm=(move(one.ends_mm[0]), move(one.ends_mm[1])))
        return replace(one, centre_mm=move(one.centre_mm))

    return replace(phantom, ellipsoids=tuple(map(body, phantom.ellipsoids)))


def scanned(rt, phantom, axis="rows", model="log", noise="none", is_fly=True, views=12):
    geometry = ConeGeometry(5.0, 7.0, (28, 32), (0.1, 0.11), (0.02, 0.05))
    scene = phantom_scene(rt, phantom, geometry, Grid.cube(20, 2.0), 20, axis, 0, pixel_samples=2)
    plan = Protocol(views=views, exposure_deg=12.0, readout_ratio=0.5, is_fly=is_fly)
    options = SimulationOptions(plan, axis, noise=noise, dose=1e5, time_samples=16, detector_model=model)
    return simulate(scene.source, geometry, scene.grid, options)


@pytest.mark.parametrize(
    ("axis", "model", "is_fly"), [("rows", "log", True), ("columns", "intensity", True), ("rows", "log", False)],
)  # fmt: skip
def test_frames_are_those_of_the_simulator(rt, known, axis, model, is_fly) -> None:
    """Of bodies that are turned and shifted there, and poses that are here; two thirds as dense."""
    scan = scanned(rt, lying(known), axis, model, is_fly=is_fly, views=3)
    problem = BeadProblem.of(known, np.array([*LYING, 1.0]), [scan], Stage(128, 6, 4))
    found, largest = problem.operator(GeometryCorrection()).forward(problem.start), scan.projections.max()
    np.testing.assert_allclose(found, scan.projections, atol=0.05 * largest)
    assert np.sqrt(np.mean((found - scan.projections) ** 2)) < 0.003 * largest
    if model == "log":
        thinner = problem.operator(GeometryCorrection()).forward(problem.start * [1, 1, 1, 1, 1, 1, 2 / 3])
        np.testing.assert_allclose(thinner, found * 2 / 3, atol=1e-5)


@pytest.mark.slow
def test_a_placement_is_found_and_a_background_taken_out(rt, known) -> None:
    scan, slope = scanned(rt, lying(known), views=5), np.linspace(0, 0.3, 32, dtype=np.float32)
    mask = np.zeros((28, 32), bool)
    mask[6:10, 5:20] = True
    scan = replace(scan, projections=np.asarray(scan.projections) + slope, pixel_mask=mask)
    problem = BeadProblem.of(known, np.array([*LYING, 1.0]) + 0.03, [scan], Stage(128, 6, 4))
    operator = problem.operator(GeometryCorrection())
    found = problem.reconstruct(operator, None, 10)
    np.testing.assert_allclose(found, [*LYING, 1.0], atol=3e-3)
    (left,) = problem.beyond_object(operator, found, [operator.forward(found) + slope], 0)
    assert np.abs(left[:, ~mask]).max() < 0.1 * slope.max()


@pytest.mark.slow
def test_beads_are_told_from_spots_that_are_none_and_from_their_mirror_image(known) -> None:
    grid, spots = Grid.cube(40, 2.0), EllipsoidPhantom((Ellipsoid((0.7, -0.7, 0.0), (0.1,) * 3, 5.0),), "spots")
    first, *_ = placements(known, lying(known).voxelise(grid) + spots.voxelise(grid), grid)
    np.testing.assert_allclose(first, LYING, atol=0.03)
    bare = replace(known, ellipsoids=known.ellipsoids[:7])
    with pytest.raises(InputError, match="of 7 beads where they should be"):
        placements(bare, np.ascontiguousarray(lying(bare).voxelise(grid)[:, :, ::-1]), grid)


@pytest.mark.slow
def test_a_scanner_is_found_by_what_it_shows_of_beads(cli, rt, file, known, tmp_path, capsys) -> None:
    """Rows read, from the other end than stated, one turn; another start of all frames is the phantom turned."""
    scan = scanned(rt, lying(known), noise="tigre", views=8)
    planted = {"readout": 0.09, "exposure": -0.17, "offset-u": 0.15, "detector-distance": -0.05, "direction": 2.0}
    off = GeometryCorrection(readout_s=0.09, exposure_s=-0.17, offset_u_mm=0.15, detector_distance_mm=-0.05)
    stated = perturb(scan, GeometryCorrection(**{name: -value for name, value in vars(off).items()}))
    path, out = tmp_path / "scan.h5", tmp_path / "out.h5"
    write_scan(path, replace(stated, shutter=replace(stated.shutter, direction=-1)))
    what = "direction,offset-u,distance,readout,exposure"
    assert cli.run(["calibrate", str(path), "--phantom", str(file), "--what", what, "-o", str(out), "--json"]) == 0
    lines = {one["name"]: one for one in json.loads(capsys.readouterr().out)["parameters"]}
    for name, one in lines.items():
        error = one["found"] - one["stated"] - planted.get(name, 0.0)
        assert one["deviation"] > 0 and abs(error) < 3 * one["deviation"], one
    for name, most in (("direction", 0.3), ("readout", 0.03), ("exposure", 0.03)):
        one = lines[name]
        assert one["verdict"] == CORRECTED and one["deviation"] < most, one
    read = load_scan(out)
    assert read.shutter.exposure_s == pytest.approx(1.0, abs=0.03) and read.shutter.readout_s == pytest.approx(0.5, abs=0.03)


@pytest.mark.slow
def test_what_is_no_known_shape_is_refused(rt, right, known) -> None:
    three = replace(known, ellipsoids=known.ellipsoids[:3])
    row = replace(known, ellipsoids=tuple(replace(known.ellipsoids[0], centre_mm=(0, 0, z / 9)) for z in range(5)))
    for phantom, said in ((three, "3 beads"), (row, "5 beads on a line"), (known, "--phantom: found")):
        with pytest.raises(InputError, match=said):
            calibrate(right, rt, "roll", phantom=phantom)
    with pytest.raises(InputError, match="with a phantom"):
        calibrate(right, rt, "wobble", phantom=known)


def test_files_of_beads_are_checked(refused, file, tmp_path) -> None:
    words = ["simulate", "--detector", "16", "--views", "2", "--phantom", tmp_path / "one.toml", "-o", tmp_path / "out.h5"]
    first, *_ = BEADS.split("bead = [")
    for old, new, said in (
        (BEADS, first, "bead: found nothing"),
        ("radius_mm = 0.08", "radius_mm = 0", "bead[1] radius_mm: found 0"),
        ("radius_mm = 0.08", "radius = 1", "bead[1] radius"),
        ("centre_mm = [0.5, 0.1, 0.4]", "centre_mm = [0.5]", "three numbers"),
        ("to_mm = [0.1, -0.2, 0.7]", "to_mm = [-0.1, 0.6, -0.7]", "two points"),
        ("[[wire]]", "[[wires]]", "did you mean 'wire'?"),
    ):
        (tmp_path / "one.toml").write_text(BEADS.replace(old, new))
        assert old in BEADS
        refused(words, said)
    refused([*words[:6], tmp_path / "none.toml", *words[7:]], "none.toml")
    refused([*words[:6], file, "-o", file], "reads or writes")

