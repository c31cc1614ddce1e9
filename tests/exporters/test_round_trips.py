"""What other programs' own libraries read: the bright voxel at its place in mm, every value, every direction."""

import json
import sys
from importlib.util import find_spec
from unittest.mock import Mock

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import tifffile

from phyradgs_cl.api import States, load_volume
from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.exporters import EXPORTS, export_volume
from phyradgs_cl.exporters.writers import write_image
from phyradgs_cl.io import write_volume

pytestmark = pytest.mark.slow
BRIGHT = (4, 1, 2)  # z, y, x


def world_mm(stored) -> tuple[float, float, float]:
    """Where the bright voxel is: x, y, z of this package's world."""
    z, y, x = (axis[i] for axis, i in zip(stored.grid.axes_mm(), BRIGHT, strict=True))
    return float(x), float(y), float(z)


@pytest.mark.parametrize("to", ["nii", "mha", "nrrd", "dicom"])
def test_simpleitk_sees_our_millimetres(volume_file, stored, to) -> None:
    """ITK's physical points are LPS, whatever the file's own frame is."""
    path = str(export_volume(volume_file, to))
    image = sitk.ReadImage(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(path) if to == "dicom" else path)
    values = sitk.GetArrayFromImage(image)
    tolerance = 0.09 / 32767 if to == "dicom" else 0
    np.testing.assert_allclose(values, stored.values, rtol=0, atol=tolerance)
    z, y, x = BRIGHT
    np.testing.assert_allclose(image.TransformIndexToPhysicalPoint((x, y, z)), world_mm(stored), atol=1e-5)
    np.testing.assert_allclose(image.GetSpacing(), stored.grid.voxel_size_mm[::-1], rtol=1e-6)
    np.testing.assert_allclose(image.GetDirection(), np.eye(3).ravel(), atol=1e-6)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_nibabel(volume_file, stored, tmp_path, suffix) -> None:
    """RAS: x and y change their sign, z is superior; sform and qform say the same."""
    path = export_volume(volume_file, "nii", tmp_path / f"out{suffix}")
    image = nibabel.load(path)
    np.testing.assert_array_equal(np.asarray(image.dataobj), stored.values.transpose(2, 1, 0))
    z, y, x = BRIGHT
    wx, wy, wz = world_mm(stored)
    np.testing.assert_allclose((image.affine @ [x, y, z, 1])[:3], (-wx, -wy, wz), atol=1e-5)
    np.testing.assert_allclose(image.get_qform(), image.get_sform(), atol=1e-5)
    assert nibabel.aff2axcodes(image.affine) == ("L", "P", "S")
    assert image.header.get_xyzt_units()[0] == "mm" and image.header["sform_code"] == 1
    np.testing.assert_allclose(image.header.get_zooms(), stored.grid.voxel_size_mm[::-1])
    assert b"1/mm" in image.header["descrip"].tobytes()
    again = export_volume(volume_file, "nii", tmp_path / f"again{suffix}").read_bytes()
    assert again == path.read_bytes() and (again[:2] == b"\x1f\x8b") == (suffix == ".nii.gz")


def test_a_compressed_file_is_read_though_its_name_is_there_without_gz(volume_file, stored, tmp_path) -> None:
    """ITK reads the other, silently."""
    image = sitk.ReadImage(str(export_volume(volume_file, "nii", tmp_path / "a.nii.gz")))
    sitk.WriteImage(2 * image, str(tmp_path / "a.nii"))
    np.testing.assert_array_equal(load_volume(tmp_path / "a.nii.gz").volume, stored.values)


def test_nifti_warns_of_states_at_uneven_times(stored, tmp_path, caplog) -> None:
    states = States(np.array([1.0, 2.0, 4.5]), np.stack([stored.values] * 3).astype(np.uint8))
    assert states.at(3.0).dtype == np.float32
    write_image(tmp_path / "s.nii", stored, "values in 1/mm", states.times_s, [stored] * 3)
    assert "one step between states, 1.75 s; theirs are uneven: [1.0, 2.0, 4.5] s" in caplog.text


def test_tifffile_as_imagej_reads_it(volume_file, stored) -> None:
    path = export_volume(volume_file, "tiff")
    assert path.suffix == ".tif"
    with tifffile.TiffFile(path) as tiff:
        np.testing.assert_array_equal(tiff.asarray(), stored.values)
        assert tiff.series[0].axes == "ZYX" and tiff.is_imagej
        facts = tiff.imagej_metadata
        dz, dy, dx = stored.grid.voxel_size_mm
        assert (facts["spacing"], facts["unit"], facts["slices"]) == (dz, "mm", 5)
        per_mm = [a / b for a, b in (tiff.pages[0].tags[f"{axis}Resolution"].value for axis in "XY")]
        np.testing.assert_allclose(per_mm, (1 / dx, 1 / dy), rtol=1e-6)
        origin = np.array([facts[f"{axis}origin"] for axis in "xyz"])
        position = (np.array(BRIGHT[::-1]) - origin) * (dx, dy, dz)  # ImageJ's calibration
        np.testing.assert_allclose(position, world_mm(stored), atol=1e-5)
        assert "1/mm" in facts["Info"]


def test_npy(volume_file, stored) -> None:
    path = export_volume(volume_file, "npy")
    np.testing.assert_array_equal(np.load(path), stored.values)
    facts = json.loads(path.with_suffix(".json").read_text())
    assert facts["values"] == "1/mm" and facts["axes"] == ["z", "y", "x"]
    place = np.array(facts["first_centre_mm"]) + np.array(BRIGHT) * facts["voxel_size_mm"]
    np.testing.assert_allclose(place[::-1], world_mm(stored))


@pytest.mark.parametrize("mu_water", [0.02, 0.0001])
def test_pydicom(volume_file, stored, mu_water) -> None:
    """Beyond 16 bits of single HU, as of metal, the rescale slope grows."""
    path = export_volume(volume_file, "dicom", mu_water_per_mm=mu_water)
    slices = [pydicom.dcmread(file) for file in sorted(path.iterdir())]
    assert len(slices) == 5
    hu = 1000 * (stored.values.astype(float) / mu_water - 1)
    for index, image in enumerate(slices):
        assert image.Modality == "CT" and image.RescaleType == "HU" and len(str(image.RescaleSlope)) <= 16
        slope = float(image.RescaleSlope)
        assert (slope == 1) == (mu_water == 0.02)
        values = image.pixel_array * slope + float(image.RescaleIntercept)
        np.testing.assert_allclose(values, hu[index], rtol=0 if slope == 1 else 1e-7, atol=slope / 2 + 1e-3)
        columns, rows = np.array(image.ImageOrientationPatient, float).reshape(2, 3)
        between_rows, between_columns = image.PixelSpacing
        position = np.array(image.ImagePositionPatient, float)
        place = position + BRIGHT[2] * between_columns * columns + BRIGHT[1] * between_rows * rows
        if index == BRIGHT[0]:
            np.testing.assert_allclose(place, world_mm(stored), atol=1e-6)
    assert len({image.SOPInstanceUID for image in slices}) == 5
    assert len({(image.SeriesInstanceUID, image.FrameOfReferenceUID) for image in slices}) == 1
    assert all(len(str(n)) <= 16 for image in slices for n in image.ImagePositionPatient)


def test_gaussians_as_npz_and_ply(volume_file, stored) -> None:
    with np.load(export_volume(volume_file, "npz"), allow_pickle=False) as arrays:
        for name, values in vars(stored.gaussians).items():
            np.testing.assert_array_equal(arrays[name], values)
    head, _, body = export_volume(volume_file, "ply").read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"] and "element vertex 9" in lines
    names = [line.split()[-1] for line in lines if line.startswith("property float")]
    rows = np.frombuffer(body, "<f4").reshape(9, len(names))
    columns, cloud = dict(zip(names, rows.T, strict=True)), stored.gaussians
    parts = {"z": cloud.mean[:, 2], "scale_1": cloud.scale[:, 1], "rot_0": cloud.quaternion[:, 0], "density": cloud.density}
    for name, values in parts.items():
        np.testing.assert_array_equal(columns[name], values)


def test_wrong_wishes_are_one_line(volume_file, tmp_path, stored) -> None:
    before = sorted(tmp_path.iterdir())
    for to, output, water, subject in (
        ("obj", None, None, "--to"), ("nii", None, 0.0, "--mu-water-per-mm"), ("nii", "none/out.nii", None, "none"),
    ):  # fmt: skip
        with pytest.raises((InputError, OutputError)) as caught:
            export_volume(volume_file, to, output and tmp_path / output, water)
        assert subject in str(caught.value) and "\n" not in str(caught.value) and sorted(tmp_path.iterdir()) == before
    write_volume(volume_file, stored.values, stored.grid, {})
    with pytest.raises(InputError, match="/entry/gaussians"):
        export_volume(volume_file, "ply")


def test_a_folder_with_content_is_never_replaced(volume_file, tmp_path) -> None:
    (thesis := tmp_path / "series/thesis.tex").parent.mkdir()
    thesis.write_text("dear")
    with pytest.raises(OutputError, match="series"):
        export_volume(volume_file, "dicom", thesis.parent)
    assert thesis.read_text() == "dear" and not list(tmp_path.glob(".*part"))


@pytest.mark.parametrize("to", [to for to in EXPORTS if to != "zarr" or find_spec("ome_zarr")])
def test_a_failure_leaves_nothing(volume_file, tmp_path, monkeypatch, to) -> None:
    """A disk that fills up at the last moment: no part of the new, and the old as it was."""
    if to not in ("dicom", "zarr"):
        export_volume(volume_file, to)
    old = {path: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr("os.replace", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(OutputError):
        export_volume(volume_file, to)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == old


def test_a_missing_package_is_named(volume_file, monkeypatch) -> None:
    for to, package in {"nii": "SimpleITK", "tiff": "tifffile", "dicom": "pydicom", "zarr": "ome_zarr.writer"}.items():
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(InputError, match=rf"{package}: .*{'zarr' if to == 'zarr' else 'formats'}\]"):
            export_volume(volume_file, to)
