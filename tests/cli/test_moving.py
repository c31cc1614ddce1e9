"""An object that moves or changes from its simulation to its states: evaluate, export, info and report."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from phyradgs_cl.api import load_volume, save_volume
from phyradgs_cl.fields import deformed
from phyradgs_cl.io import Volume, read_deformation, read_volume, write_deformation, write_volume
from phyradgs_cl.metrics import compare
from phyradgs_cl.workflow import load_scan
from phyradgs_cl.workflow.volumes import compared_states

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("fast_pictures")]
MOTION = 'kind = "breathing"\namplitude = 0.3\nperiod_s = 2.0\nstates = 3\n'
SCAN = "--phantom jaw --size 12 --detector 12 --views 4 --time-samples 1 --protocol static"


@pytest.fixture(scope="module")
def folder(cli, tmp_path_factory) -> Path:
    """A scan of a moving object, its reference as a result, and its deformation."""
    path = tmp_path_factory.mktemp("moving")
    (path / "motion.toml").write_text(MOTION)
    assert cli.run(f"simulate {SCAN} --motion-of-object {path / 'motion.toml'} -o {path / 'scan.h5'}".split()) == 0
    scan = load_scan(path / "scan.h5")
    write_volume(path / "volume.h5", scan.reference, scan.grid, {"method": "made up"})
    write_deformation(path / "field.h5", scan.moving_truth.deformation)
    return path


def test_a_volume_is_compared_with_every_state(told, refused, folder) -> None:
    line = f"evaluate {folder}/volume.h5 --reference {folder}/scan.h5"
    still, moving = (told(f"{line} --json {more}") for more in ("", f"--object-motion {folder}/field.h5"))
    assert still["psnr_db"] is None and len(still["states"]) == len(moving["states"]) == 3
    assert moving["mean_psnr_db"] > still["mean_psnr_db"] + 3
    assert moving["mean_motion_error_mm"] == 0 and "mean_motion_error_mm" not in still
    assert (printed := told(line)).count("\nat ") == 3 and "mean of 3 states" in printed
    line = f"evaluate {folder}/volume.h5 --reference {folder}/volume.h5 --object-motion {folder}/field.h5"
    refused(line.split(), "--object-motion")


def test_a_run_that_finds_the_motion_prints_the_mean_of_the_true_states(told, folder, tmp_path) -> None:
    """Its own reference state may lie anywhere between them."""
    out = tmp_path / "moving.h5"
    printed = told(f"reconstruct {folder}/scan.h5 -o {out} --method moving --iterations 2")
    facts = told(f"evaluate {out} --reference {folder}/scan.h5 --json")
    assert f"PSNR {facts['mean_psnr_db']:.2f} dB" in printed and "(mean of 3 states)" in printed
    assert read_volume(out).metrics["psnr_db"] == pytest.approx(facts["mean_psnr_db"], rel=1e-6)


def test_a_volume_with_its_own_deformation_needs_no_other(told, folder, tmp_path) -> None:
    """As ``--method moving`` writes it: for evaluate, export, and as the motion of another run."""
    scan = load_scan(folder / "scan.h5")
    field, own = scan.moving_truth.deformation, tmp_path / "own.h5"
    write_volume(own, scan.reference, scan.grid, {"method": "moving"}, deformation=field)
    np.testing.assert_array_equal(read_volume(own).deformation.control_mm, field.control_mm)
    facts = told(f"evaluate {own} --reference {folder}/scan.h5 --json")
    assert facts["mean_motion_error_mm"] == 0  # which nothing has without a field
    facts, of_field = (told(f"info {path} --json") for path in (own, folder / "field.h5"))
    assert facts["motion_displacements_below_mm"] == of_field["displacements_below_mm"] > 0
    assert "2 states from" in told(f"export {own} --states 2 -o {tmp_path}/state.npy")
    assert (tmp_path / "state_02.json").exists()
    line = f"reconstruct {folder}/scan.h5 -o {tmp_path}/cloud.h5 --method phyradgs --object-motion {own}"
    told(f"{line} --iterations 2 --gaussians 30")
    assert read_volume(tmp_path / "cloud.h5").provenance["object_motion"] == str(own)


def test_states_are_compared_where_the_error_of_the_motion_is_not_known(caplog, folder) -> None:
    scan = load_scan(folder / "scan.h5")
    field = scan.moving_truth.deformation
    steep = replace(field, control_mm=10 * field.control_mm)  # with slopes above 1: no inverse is found
    facts = compared_states(Volume(scan.reference, scan.grid, deformation=steep), scan.moving_truth, scan.grid)
    assert len(facts["states"]) == 3 and "mean_motion_error_mm" not in facts
    assert "no error of the motion: deformation: found no inverse" in caplog.text


def test_an_object_that_changes_from_the_scan_to_its_states(told, refused, folder, tmp_path) -> None:
    scan, own = folder / "scan.h5", tmp_path / "own.h5"
    line = f"reconstruct {scan} -o {own} --method changing --set states=3 --iterations 5"
    assert "\nstates of the object: 3, " in told(line)
    stored = read_volume(own)
    assert stored.states.volumes.shape == (3, *stored.values.shape)
    facts = told(f"info {own} --json")
    assert (facts["states"], facts["states_from_s"]) == (3, stored.states.times_s[0])
    compared, truth = told(f"evaluate {own} --reference {scan} --json")["states"], load_scan(scan).moving_truth
    expected = [compare(stored.at(t), true)["psnr_db"] for t, true in zip(truth.times_s, truth.volumes, strict=True)]
    np.testing.assert_allclose([state["psnr_db"] for state in compared], expected, rtol=1e-5)
    told(f"export {own} --states 2 -o {tmp_path}/state.npy")
    first_s, last_s = stored.states.span_s
    np.testing.assert_allclose(np.load(tmp_path / "state_02.npy"), stored.at(first_s + 0.75 * (last_s - first_s)), atol=1e-7)
    told(f"report {own} --views 1 -o {tmp_path}/page.html")
    page = (tmp_path / "page.html").read_text()
    assert 'id="states"' in page and page.count("slice of the state ") == 9
    save_volume(tmp_path / "again.h5", load_volume(own))
    np.testing.assert_array_equal(read_volume(tmp_path / "again.h5").states.volumes, stored.states.volumes)
    motion = f"--object-motion {folder}/field.h5"
    for line in (f"evaluate {own} --reference {scan} {motion}", f"export {own} -o {tmp_path}/no.nii {motion}"):
        refused(line.split(), "--object-motion")
    line = f"reconstruct {scan} -o {tmp_path}/no.h5 --method changing --memory 40KiB"
    refused(line.split(), "--set states=N", status=6)


def test_evaluate_names_the_field_that_a_volume_was_reconstructed_with(told, caplog, folder, tmp_path) -> None:
    scan, path = load_scan(folder / "scan.h5"), tmp_path / "with_field.h5"
    write_volume(path, scan.reference, scan.grid, {"method": "fista", "object_motion": f"{folder}/field.h5"})
    for more, warned in (("", True), (f" --object-motion {folder}/field.h5", False)):
        caplog.clear()
        told(f"evaluate {path} --reference {folder}/scan.h5{more}")
        assert (f"reconstructed with --object-motion {folder}/field.h5: add it" in caplog.text) == warned


def test_states_go_into_one_nifti_of_four_dimensions_which_info_describes(told, folder) -> None:
    told(f"export {folder}/volume.h5 --object-motion {folder}/field.h5 --states 4 --during 1,5 -o {folder}/states.nii")
    image, field = sitk.ReadImage(str(folder / "states.nii")), read_deformation(folder / "field.h5")
    volume, states = read_volume(folder / "volume.h5"), sitk.GetArrayFromImage(image)
    assert image.GetDimension() == 4 and image.GetSpacing() == pytest.approx((*volume.grid.voxel_size_mm, 1.0))
    for values, time_s in zip(states, (1.5, 2.5, 3.5, 4.5), strict=True):
        np.testing.assert_array_equal(values, deformed(volume.values, volume.grid, field, field.weights_at(time_s)[0]))
    assert np.ptp(states, axis=0).max() > 0.1
    facts = told(f"info {folder}/states.nii --json")
    assert "moves (NIfTI)" in facts["kind"] and facts["shape"] == list(volume.grid.shape)
    assert (facts["states"], facts["first_s"], facts["last_s"]) == (4, 1.5, pytest.approx(4.5))
    assert facts["maximum"] == pytest.approx(float(states.max()))


def test_wrong_wishes_are_one_line(refused, folder, monkeypatch) -> None:
    monkeypatch.chdir(folder)
    write_deformation("far.h5", replace(read_deformation("field.h5"), origin_mm=(100.0, 0.0, 0.0)))
    for options, subject in (
        ("--states 4", "--states"), ("--object-motion field.h5 --states 0", "--states"),
        ("--object-motion field.h5 --during 2,1", "--during"), ("--object-motion field.h5 --during 100,200", "--during"),
        ("--object-motion far.h5", "moves nothing"), ("--object-motion field.h5 --to ply", "--states"),
        ("--object-motion volume.h5", "volume.h5:/"),
    ):  # fmt: skip
        refused(f"export volume.h5 --to npy {options}".split(), subject)


def test_info_describes_a_deformation_and_the_states_of_a_scan(told, refused, folder) -> None:
    facts = told(f"info {folder}/field.h5 --json")
    assert facts["kind"] == "deformation" and facts["fields"] == 2 and 0 < facts["smallest_determinant"] < 1
    assert facts["displacements_below_mm"] == pytest.approx(0.3, abs=0.12)
    of_scan, scan = told(f"info {folder}/scan.h5 --json"), load_scan(folder / "scan.h5")
    assert of_scan["true_states"] == 3 and of_scan["gating"] == "a signal"
    weights = scan.moving_truth.deformation.weights_at(scan.gating.times_s)
    np.testing.assert_array_equal(scan.gating.values, weights[:, 0])
    refused(f"reconstruct {folder}/field.h5 -o {folder}/x.h5".split(), "how an object moves")
