"""The picture of a run under way, and the window of a finished one."""

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from skimage import io

import phyradgs_cl
from phyradgs_cl.acquisition import pixel_centres
from phyradgs_cl.api import save_scan, simulate
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import write_volume
from phyradgs_cl.report import write_preview
from phyradgs_cl.report.preview import preview_image

pytestmark = pytest.mark.slow

GAP = 4


def test_three_slices_stand_upright_in_their_proportions(any_volume, tmp_path) -> None:
    volume, grid = any_volume  # 1.5 × 1.2 × 0.8 mm (z, y, x), brighter upwards
    write_preview(volume, grid, tmp_path / "p.png")
    picture, per_mm = io.imread(tmp_path / "p.png"), 128 / 1.5
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
    refused(["view", tmp_path / "v.h5"], "pip install 'phyradgs-cl[view]'")


def test_napari_reads_volumes_and_scans_by_the_manifest(any_volume, tmp_path) -> None:
    """What the manifest names exists; values, scale, position and units are the file's. Other files are left to others."""
    volume, grid = any_volume
    write_volume(tmp_path / "v.h5", volume, grid, {})
    manifest = yaml.safe_load((Path(phyradgs_cl.__file__).parent / "napari.yaml").read_text(encoding="utf-8"))
    (command,), (reader,) = (manifest["contributions"][key] for key in ("commands", "readers"))
    assert reader["command"] == command["id"] and reader["filename_patterns"] == ["*.h5"]
    module, _, name = command["python_name"].partition(":")
    choose = getattr(importlib.import_module(module), name)
    ((values, how, kind),) = choose(str(tmp_path / "v.h5"))(str(tmp_path / "v.h5"))
    assert np.array_equal(values, volume) and kind == "image"
    assert (how["scale"], how["translate"], how["units"]) == (grid.voxel_size_mm, grid.first_centre_mm, ("mm", "mm", "mm"))
    scan = simulate("jaw", size=8, detector=12, views=5, protocol="static", detector_offset_mm=(0.25, -0.5))
    save_scan(tmp_path / "s.h5", scan)
    both = [str(tmp_path / "v.h5"), str(tmp_path / "s.h5")]
    _, (values, how, _) = choose(both)(both)
    assert np.array_equal(values, scan.projections) and how["axis_labels"] == ("projection", "v", "u")
    pixel = np.array(how["translate"]) + np.array(how["scale"]) * [3, 0, 11]  # the last column of the lowest row
    expected = pixel_centres(scan.geometry.pose(0.0), scan.geometry.detector_shape)[0, 11]
    np.testing.assert_allclose(pixel, [3, expected[2], expected[1]], atol=1e-12)
    (tmp_path / "other.h5").write_bytes(b"no HDF5")
    assert choose(str(tmp_path / "other.h5")) is None and choose([*both, str(tmp_path / "other.h5")]) is None
