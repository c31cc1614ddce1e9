"""--preview: a picture of the run under way, which changes nothing about the run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from skimage.io import imread

from phyradgs_cl.errors import OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import read_volume
from phyradgs_cl.reconstructors.result import Progress
from phyradgs_cl.report import Preview

SIMULATE = ["simulate", "--phantom", "jaw", "--size", "12", "--detector", "16", "--views", "4", "--time-samples", "2"]
RUNS = {
    "phyradgs": ["--iterations", "60", "--gaussians", "60"],
    "footprint": ["--iterations", "60", "--gaussians", "60", "--set", "pixel_footprint=true"],
    "sirt": ["--method", "sirt", "--iterations", "3"],
}


@pytest.fixture(scope="module")
def scan(simulated) -> Path:
    return simulated(*SIMULATE[1:])


@pytest.mark.parametrize("name", RUNS)
def test_a_run_with_pictures_is_the_same_run(cli, scan, tmp_path, name) -> None:
    picture, seen, plain = tmp_path / "now.png", tmp_path / "seen.h5", tmp_path / "plain.h5"
    for output, more in ((seen, ["--preview", str(picture)]), (plain, [])):
        assert cli.run(["reconstruct", str(scan), "-o", str(output), *RUNS[name], *more]) == 0
    np.testing.assert_array_equal(read_volume(seen).volume, read_volume(plain).volume)
    assert imread(picture).max() > 0 and not (tmp_path / "now.partial.png").exists()


def test_the_picture_is_of_the_present_volume(tmp_path) -> None:
    grid, told = Grid.cube(4, 2.0), []
    preview = Preview(tmp_path / "now.png", told.append, every_s=0.0)
    pictures = []
    for value in (0.0, 1.0):
        volume = np.zeros(grid.shape, np.float32)
        volume[2, 2, 2] = value
        preview(Progress(1, 9, 0.5, 0, 1.0, volume=lambda v=volume: (v, grid)))
        pictures.append(imread(tmp_path / "now.partial.png"))
    assert pictures[0].max() == 0 and pictures[1].max() == 255
    preview.finish(volume, grid)
    assert [path.name for path in tmp_path.iterdir()] == ["now.png"]
    assert len(told) == 2


def test_pictures_are_no_more_often_than_asked(tmp_path) -> None:
    grid, made = Grid.cube(4, 2.0), []

    def volume() -> tuple[np.ndarray, Grid]:
        made.append(1)
        return np.ones(grid.shape, np.float32), grid

    preview = Preview(tmp_path / "now.png", lambda progress: None, every_s=1000.0)
    for iteration in range(5):
        preview(Progress(iteration, 9, 0.5, 0, 1.0, volume=volume))
    assert len(made) == 1


def test_a_picture_that_cannot_be_written_is_one_warning(tmp_path, monkeypatch, caplog) -> None:
    def full(*arguments: object) -> None:
        raise OutputError("now.png", "no room left")

    monkeypatch.setattr("phyradgs_cl.report.pictures.preview.write_preview", full)
    preview = Preview(tmp_path / "now.png", lambda progress: None, every_s=0.0)
    for iteration in range(3):
        preview(Progress(iteration, 9, 0.5, 0, 1.0, volume=lambda: (np.ones((2, 2, 2)), Grid.cube(2, 2.0))))
    assert caplog.text.count("no preview") == 1


@pytest.mark.parametrize("name", ["scan", "output", "other kind"])
def test_pictures_do_not_replace_what_matters(cli, scan, tmp_path, capsys, name) -> None:
    output = tmp_path / "volume.png"
    picture = {"scan": scan, "output": output, "other kind": tmp_path / "now.jpg"}[name]
    before = scan.read_bytes()
    assert cli.run(["reconstruct", str(scan), "-o", str(output), "--preview", str(picture)]) == 2
    assert "--preview" in capsys.readouterr().err and scan.read_bytes() == before
