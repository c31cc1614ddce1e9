"""The grid of a volume, chosen on the command line: what is in the file, said, scored and refused."""

import h5py
import numpy as np
import pytest

from phyradgs_cl.fields import Grid
from phyradgs_cl.io import read_volume, write_volume
from phyradgs_cl.report.run import load_run
from phyradgs_cl.workflow import load_scan

pytestmark = pytest.mark.slow
INSIDE = "-0.5,0.5,-0.5,0.75,-0.75,0.5"  # of a box of ±1 mm in voxels of 0.25 mm
SIRT = ["--method", "sirt", "--iterations", "2"]


def test_what_is_chosen_is_in_the_result_and_told(told, scan, tmp_path, caplog) -> None:
    output = tmp_path / "v.h5"
    line = told(f"reconstruct {scan} -o {output} --method FDK --size 10,11,12")
    stored = read_volume(output)
    assert stored.grid == Grid((10, 11, 12), (0.2, 2 / 11, 2 / 12))
    assert stored.provenance["input"]["size"] == [10, 11, 12] and stored.provenance["method"] == "fdk"
    with h5py.File(output) as file:
        assert file["entry/reconstruction/x"][()] == pytest.approx(stored.grid.axes_mm()[2])
    assert not caplog.records and " size (10, 11, 12), " in told("info", output)
    assert f"PSNR {stored.metrics['psnr_db']:.2f} dB" in line and "resampled (linear) from 12×11×10 voxels" in line
    run = load_run(output, scan)
    assert run.reference is None and "its slices are not shown" in run.notes[-1]
    assert run.metrics == stored.metrics and "resampled" in run.compared
    line = told(f"reconstruct {scan} -o {output} --method fdk --size 4")
    assert "with means of the reference over 2×2×2 voxels" in line
    stored, run = read_volume(output), load_run(output, scan)
    assert run.compared == stored.provenance["compared"] and run.reference.shape == (4, 4, 4)
    write_volume(output, stored.values, stored.grid, stored.provenance)  # as written before there was a score
    assert load_run(output, scan).metrics["psnr_db"] == pytest.approx(stored.metrics["psnr_db"])


def test_a_part_of_the_grid_has_the_same_voxels_and_a_score_where_the_object_is(cli, scan, tmp_path, caplog) -> None:
    whole, part = tmp_path / "whole.h5", tmp_path / "part.h5"
    command = ["reconstruct", str(scan), "--method", "fdk"]
    assert cli.run([*command, "-o", str(whole)]) == 0
    assert cli.run([*command, "-o", str(part), "--roi-mm", INSIDE]) == 0 and caplog.records == []
    found, same = read_volume(part), read_volume(whole).values[2:6, 2:7, 1:6]
    np.testing.assert_allclose(found.values, same, atol=1e-5 * np.abs(same).max())
    assert found.metrics["psnr_db"] > 0
    np.testing.assert_array_equal(load_run(part, scan).reference, load_scan(scan).reference[2:6, 2:7, 1:6])
    assert cli.run([*command, "-o", str(part), "--roi-mm", "-1,-0.75,-1,-0.75,-1,-0.75"]) == 0
    assert "nothing of the scan's reference lies in the volume's box" in caplog.text
    assert read_volume(part).metrics is None and "no PSNR" in load_run(part, scan).notes[-1]


def test_a_box_inside_of_what_is_seen_is_said_where_it_matters(cli, scan, tmp_path, caplog) -> None:
    command = ["reconstruct", str(scan), "-o", str(tmp_path / "v.h5"), *SIRT]
    assert cli.run([*command, "--voxel-mm", "0.5"]) == 0
    assert not any("field of view" in record.getMessage() for record in caplog.records)
    assert cli.run([*command, "--roi", INSIDE]) == 0
    (line,) = [r.getMessage() for r in caplog.records if "field of view" in r.getMessage()]
    assert "--method sirt puts the object beyond it into the grid" in line and "--margin-mm reconstructs a margin" in line
    alone = read_volume(tmp_path / "v.h5")
    for margin_mm, expected in (("0.5,0,0", "widen --margin-mm"), ("0.5", "")):
        caplog.clear()
        assert cli.run([*command, "--roi", INSIDE, "--margin-mm", margin_mm]) == 0
        assert len(caplog.records) == bool(expected) and expected in caplog.text
    found = read_volume(tmp_path / "v.h5")
    assert found.grid == alone.grid and found.metrics["psnr_db"] > alone.metrics["psnr_db"] + 3
    assert found.provenance["input"]["margin_mm"] == [0.5] * 3
    assert "margin around the box is discarded" in load_run(tmp_path / "v.h5", scan).notes[-1]
