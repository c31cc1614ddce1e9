"""The picture of a run under way, and the window of a finished one."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
from skimage import io

from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume
from phyradgs_cl.report import write_preview
from phyradgs_cl.report.preview import preview_image

GAP = 4


def test_three_slices_stand_upright_in_their_proportions(any_volume, tmp_path) -> None:
    volume, grid = any_volume  # 1.5 × 1.2 × 0.8 mm (z, y, x), brighter upwards
    write_preview(volume, grid, tmp_path / "p.png")
    picture = io.imread(tmp_path / "p.png")
    per_mm = 128 / 1.5
    widths = [round(side * per_mm) for side in (0.8, 0.8, 1.2)]
    assert picture.shape == (128, sum(widths) + 2 * GAP)
    coronal = picture[:, widths[0] + GAP : widths[0] + GAP + widths[1]]
    assert np.all(np.diff(coronal[:, 0].astype(int)) <= 0)  # z falls from the top down
    axial = picture[128 - round(1.2 * per_mm) :, : widths[0]]
    assert axial[0, 0] > axial[-1, 0] and axial[-1, -1] > axial[-1, 0]
    assert not picture[: 128 - round(1.2 * per_mm), : widths[0]].any()  # above the lower slice


def test_a_single_layer_is_shown_from_its_face_only(any_volume) -> None:
    volume, grid = any_volume
    middle = grid.shape[0] // 2
    layer = grid.part((middle, 0, 0), (1, *grid.shape[1:]))
    picture = preview_image(volume[middle : middle + 1], layer)
    assert picture.shape[0] / picture.shape[1] == pytest.approx(1.2 / 0.8, rel=0.02)  # one slice, no gap
    line = grid.part((middle, 0, 0), (1, 1, grid.shape[2]))
    assert preview_image(volume[middle : middle + 1, :1], line).size > 0


def test_black_is_nothing_and_white_is_nearly_the_most(tmp_path) -> None:
    volume = np.zeros((16, 16, 16), np.float32)
    volume[8, 8, 8] = 100.0  # a hot voxel
    volume[4:12, 4:12, 4:12] += 1.0
    picture = preview_image(volume, Grid.cube(16, 2.0))
    assert set(np.unique(picture)) == {0, 255}
    assert not preview_image(np.zeros((4, 4, 4), np.float32), Grid.cube(4, 1.0)).any()


def test_a_preview_replaces_the_last_one_whole(any_volume, tmp_path) -> None:
    volume, grid = any_volume
    write_preview(volume, grid, tmp_path / "p.png")
    write_preview(volume[::-1], grid, tmp_path / "p.png")
    assert [path.name for path in tmp_path.iterdir()] == ["p.png"]
    for wrong, said in ((np.full(grid.shape, np.nan), "NaN"), (volume[1:], "shape")):
        with pytest.raises(InputError, match=said):
            write_preview(wrong, grid, tmp_path / "p.png")
    with pytest.raises(OutputError):
        write_preview(volume, grid, tmp_path / "none" / "p.png")


class FakeViewer(SimpleNamespace):
    def __init__(self, title: str) -> None:
        super().__init__(title=title, images=[])
        self.dims, self.camera, self.scale_bar = SimpleNamespace(), SimpleNamespace(), SimpleNamespace()
        self.camera.orientation2d = ("down", "right")
        opened.append(self)

    def add_image(self, data: np.ndarray, **how: object) -> None:
        self.images.append((data, how))


opened: list[FakeViewer] = []


def test_the_window_has_the_volume_in_millimetres(cli, refused, any_volume, tmp_path, monkeypatch) -> None:
    """Without napari one line says what to install."""
    volume, grid = any_volume
    write_volume(tmp_path / "v.h5", volume, grid, {})
    ran = []
    monkeypatch.setitem(sys.modules, "napari", SimpleNamespace(Viewer=FakeViewer, run=lambda: ran.append(1)))
    assert cli.run(["view", str(tmp_path / "v.h5")]) == 0 and ran
    ((data, how),) = opened[-1].images
    assert np.array_equal(data, volume)
    assert how["scale"] == grid.voxel_size_mm and how["translate"] == grid.first_centre_mm
    assert how["units"] == ("mm", "mm", "mm") and how["axis_labels"] == ("z", "y", "x")
    assert opened[-1].dims.axis_labels == ("z", "y", "x") and opened[-1].scale_bar.visible
    assert opened[-1].camera.orientation2d == ("up", "right")
    monkeypatch.setitem(sys.modules, "napari", None)
    refused(["view", tmp_path / "v.h5"], "pip install 'napari")
