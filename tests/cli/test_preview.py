"""--preview: a picture of the run under way, which changes nothing about the run."""

import numpy as np
import pytest
from skimage.io import imread

from phyradgs_cl.errors import OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.result import Progress
from phyradgs_cl.report import Preview

pytestmark = pytest.mark.slow
GRID = Grid.cube(4, 2.0)


def test_the_picture_is_of_the_present_volume(tmp_path) -> None:
    pictures = []
    preview = Preview(tmp_path / "now.png", every_s=0.0)
    for value in (0.0, 1.0):
        volume = np.zeros(GRID.shape, np.float32)
        volume[2, 2, 2] = value
        preview(Progress(1, 9, 0.5, 0, 1.0, volume=lambda v=volume: (v, GRID)))
        pictures.append(imread(tmp_path / "now.partial.png"))
    assert pictures[0].max() == 0 and pictures[1].max() == 255
    preview.finish(volume, GRID)
    assert [path.name for path in tmp_path.iterdir()] == ["now.png"]


def test_pictures_are_no_more_often_than_asked_and_cost_one_warning(tmp_path, monkeypatch, caplog) -> None:
    def full(*arguments: object) -> None:
        raise OutputError("now.png", "no room left")

    def volume() -> tuple[np.ndarray, Grid]:
        made.append(1)
        return np.ones(GRID.shape, np.float32), GRID

    for every_s, times in ((1000.0, 1), (0.0, 5)):
        made: list[int] = []
        preview = Preview(tmp_path / "now.png", every_s)
        for iteration in range(5):
            preview(Progress(iteration, 9, 0.5, 0, 1.0, volume=volume))
        assert len(made) == times and caplog.text == ""
    monkeypatch.setattr("phyradgs_cl.report.preview.write_preview", full)
    for iteration in range(3):
        preview(Progress(iteration, 9, 0.5, 0, 1.0, volume=volume))
    assert caplog.text.count("no preview") == 1
