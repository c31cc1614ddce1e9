"""Gaussians fitted to volumes, and the command that does it."""

import json

import h5py
import numpy as np
import pytest

from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters import export_volume
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import read_volume, write_volume
from phyradgs_cl.metrics import psnr
from phyradgs_cl.operators import voxelise
from phyradgs_cl.operators.twins.splat import voxel_field
from phyradgs_cl.reconstructors.splats.volume_fit import VolumeFitOptions, drawn_by_gradient, fit_volume

GRID = Grid((10, 12, 14), (0.5, 0.4, 0.3), (3.0, -2.0, 1.0))


def two_balls(grid: Grid = GRID) -> np.ndarray:
    """A ball with a denser one inside, in 1/mm."""
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    distance = np.sqrt(sum((a - c) ** 2 for a, c in zip((z, y, x), grid.offset_mm, strict=True)))
    return (0.02 * (distance < 1.8) + 0.03 * (distance < 0.9)).astype(np.float32)


def test_a_fit_is_near_and_its_cloud_is_its_volume(rt) -> None:
    """In place and to scale, on voxels that are no cubes; more steps are nearer; the same seed gives the same bits."""
    volume, reports = two_balls(), []
    near = fit_volume(rt, volume, GRID, VolumeFitOptions(600, 60), report=reports.append)
    start = fit_volume(rt, volume, GRID, VolumeFitOptions(600, 0))
    assert psnr(near.volume, volume) > max(32, psnr(start.volume, volume) + 8)
    errors = [p.loss for p in reports]
    assert len(errors) == 6 and errors == sorted(errors, reverse=True) and near.gaussians.count == 600
    rows = near.gaussians.rows()
    np.testing.assert_allclose(voxelise(rt, rows, GRID), near.volume, rtol=0, atol=1e-4 * volume.max())
    twin = voxel_field(rows, *GRID.axes_mm())
    np.testing.assert_allclose(near.volume, twin, rtol=0, atol=0.02 * volume.max())  # the cutoff's edge
    again = fit_volume(rt, volume, GRID, VolumeFitOptions(600, 60))
    np.testing.assert_array_equal(again.volume, near.volume)
    other = fit_volume(rt, volume, GRID, VolumeFitOptions(600, 60), seed=1)
    assert (other.volume != near.volume).any()


def test_gaussians_are_drawn_where_the_volume_changes() -> None:
    volume, rng = two_balls(), np.random.default_rng(0)
    places = drawn_by_gradient(volume, 300, rng)
    assert len(places) == len(set(places.tolist())) == 300
    steepness = np.sqrt(sum(part**2 for part in np.gradient(volume))).ravel()
    assert steepness[places].mean() > 1.5 * steepness.mean()
    assert len(drawn_by_gradient(volume, 10**6, rng)) < volume.size  # not in the air
    assert len(drawn_by_gradient(np.ones((3, 4, 1)), 10**6, rng)) == 12  # a constant, of one slice
    with pytest.raises(InputError, match="volume: found a largest value of 0"):
        drawn_by_gradient(np.zeros((4, 4, 4)), 10, rng)


@pytest.fixture
def volume_file(tmp_path):
    write_volume(tmp_path / "v.h5", two_balls(), GRID, {})
    return tmp_path / "v.h5"


def test_the_command_writes_every_kind_of_cloud(cli, volume_file, tmp_path, capsys) -> None:
    line = ["splat", str(volume_file), "--gaussians", "300", "--iterations", "5", "--seed", "3"]
    outputs = [tmp_path / name for name in ("c.h5", "c.ply", "c.npz")]
    for output in outputs:
        assert cli.run([*line, "-o", str(output), "--json"]) == 0
        facts = json.loads(capsys.readouterr().out)
    assert facts["gaussians"] == 300 and facts["compression"] == pytest.approx(10 * 12 * 14 / (11 * 300))
    stored = read_volume(outputs[0])
    assert stored.grid == GRID and stored.gaussians.count == 300 and stored.provenance["method"] == "splat"
    assert psnr(stored.values, two_balls()) == pytest.approx(facts["psnr_db"], abs=1e-6)
    for output in outputs[1:]:
        exported = export_volume(outputs[0], output.suffix[1:], tmp_path / f"other{output.suffix}")
        if output.suffix == ".ply":
            assert exported.read_bytes() == output.read_bytes()
    clouds = np.load(outputs[2]), np.load(exported)
    assert all(np.array_equal(clouds[0][name], clouds[1][name]) for name in vars(stored.gaussians))
    assert cli.run([*line, "-o", str(outputs[0])]) == 0
    assert "300 Gaussians, voxels / parameters 0.509, PSNR" in capsys.readouterr().out


def test_what_the_command_refuses_is_one_line(cli, volume_file, tmp_path, capsys, monkeypatch) -> None:
    with h5py.File(tmp_path / "bare.h5", "w") as file:
        file["volume"] = two_balls()
    out = ["-o", str(tmp_path / "c.h5"), "--iterations", "1", "--gaussians", "20"]
    bare, hot = str(tmp_path / "bare.h5"), two_balls()
    hot[5, 5, 5] = 1e30
    np.save(tmp_path / "hot.npy", hot)
    for words, message in (
        ([str(volume_file), "-o", str(tmp_path / "c.nii")], "no place for Gaussians"),
        ([str(volume_file), "-o", str(tmp_path / "c.obj")], "ends in .h5, .ply or .npz"),
        ([str(volume_file), "-o", str(volume_file)], "reads or writes"), ([bare, *out], "--voxel-mm"),
        ([str(volume_file), *out, "--voxel-mm", "1"], "a volume without a scale"),
        ([str(volume_file), *out, "--iterations", "-1"], "--iterations"), ([str(tmp_path / "no.h5"), *out], "no.h5"),
        ([str(tmp_path / "hot.npy"), *out, "--voxel-mm", "1"], "hot.npy: found a value of size 1e+30"),
    ):  # fmt: skip
        assert cli.run(["splat", *words]) == 2
        errors = capsys.readouterr().err
        assert errors.count("\n") == 1 and message in errors, (words, errors)
    assert cli.run(["splat", bare, *out, "--voxel-mm", "0.5,0.4,0.3"]) == 0
    (tmp_path / "c.h5").unlink()

    def interrupted(*arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("phyradgs_cl.reconstructors.splats.volume_fit._Fit.step", interrupted)
    assert cli.run(["splat", str(volume_file), *out]) == 130
    assert "nothing written" in capsys.readouterr().err and not (tmp_path / "c.h5").exists()
