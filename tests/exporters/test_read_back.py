"""What `export` writes is read back as it was, and so is what other programs make of it."""

import json
import re
import shutil
from importlib.util import find_spec

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk

from phyradgs_cl.errors import InputError
from phyradgs_cl.exporters import export_volume, hu_scale
from phyradgs_cl.fields import Hounsfield
from phyradgs_cl.importers import foreign_volume, load_attenuation, load_volume
from phyradgs_cl.io import read_volume, write_volume
from phyradgs_cl.io.attenuation import attenuation_of

pytestmark = pytest.mark.slow
NAMES = {"v.mha": "mha", "v.nii": "nii", "v.nii.gz": "nii", "v.nrrd": "nrrd", "v.npy": "npy", "v.tif": "tiff"}
NAMES |= {"v.ome.zarr": "zarr"} if find_spec("ome_zarr") else {}


@pytest.fixture
def exported(volume_file, tmp_path):
    def export(name, **wish):
        shutil.rmtree(tmp_path / name, ignore_errors=True)  # a folder is never replaced
        return export_volume(volume_file, NAMES[name], tmp_path / name, **wish)

    return export


def assert_same(path, stored, atol: float = 0) -> None:
    np.testing.assert_allclose((loaded := load_volume(path)).values, stored.values, rtol=0, atol=atol)
    assert loaded.values.dtype == np.float32 and loaded.grid.is_close(stored.grid), loaded.grid


@pytest.mark.parametrize("name", NAMES)
def test_an_export_comes_back_bit_for_bit_and_in_its_place(exported, stored, tmp_path, name) -> None:
    """Hounsfield units too, by the scale that the file notes; of a file without one they are refused, or converted once. So
    are values of any size where the file notes their unit: of voxels of nanometres they are as large as Hounsfield units."""
    assert_same(exported(name), stored)
    assert foreign_volume(f"{name.upper()}") and load_attenuation(exported(name)).grid is not None
    scale = Hounsfield(0.02, 0.001)
    assert_same(path := exported(name, scale_of=lambda _: scale), stored, atol=1e-8)
    assert load_volume(path).scale == scale and load_volume(path, 0.03).scale == scale
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Hounsfield, "note", "values in HU")
        path = exported(name, mu_water_per_mm=0.02)
    with pytest.raises(InputError, match="Hounsfield.*--mu-water-per-mm"):
        load_volume(path)
    np.testing.assert_allclose(load_volume(path, 0.02).values, stored.values, atol=1e-8)
    write_volume(tmp_path / "dense.h5", stored.values * np.float32(1e6), stored.grid, {})
    path = export_volume(tmp_path / "dense.h5", NAMES[name], tmp_path / f"dense.{name}")
    assert_same(path, read_volume(tmp_path / "dense.h5"))
    for loaded in (load_volume(path), load_volume(path, 0.02)):
        assert attenuation_of(str(path), loaded) is loaded and np.abs(loaded.values).max() > 1000


def test_a_volume_file_keeps_its_scale_and_all_else(volume_file, stored, tmp_path) -> None:
    """Its values stay in 1/mm; later exports take the scale from it."""
    scale = Hounsfield(0.02, 0.001, "by hand")
    path = export_volume(volume_file, "h5", tmp_path / "own.h5", scale_of=lambda _: scale)
    again = read_volume(path)
    assert_same(path, stored)
    assert again.scale == scale and again.gaussians.count == stored.gaussians.count
    assert again.provenance["method"] == "phyradgs"
    kept = load_volume(export_volume(path, "nii", tmp_path / "own.nii", scale_of=hu_scale))
    assert (kept.scale.water_per_mm, kept.scale.air_per_mm) == (0.02, 0.001)
    with pytest.raises(InputError, match="--hu: not given"):
        export_volume(volume_file, "h5", tmp_path / "none.h5")


def test_a_bigtiff_has_the_same_grid(exported, stored, monkeypatch) -> None:
    monkeypatch.setattr("phyradgs_cl.exporters.writers._MOST_IMAGEJ_BYTES", 100)
    path = exported("v.tif")
    assert path.read_bytes()[:4] == b"II\x2b\x00"
    assert_same(path, stored)


TURNED = [("t.mhd", "PIR"), ("t.nii", "SAL"), ("t.nii.gz", "ARS"), ("t.nrrd", "PIR"), ("t.mha", "RAS"), ("t.mha", "LPI")]


@pytest.mark.parametrize(("name", "order"), TURNED)
def test_itk_s_other_orders_and_directions_are_turned_to_the_world_s(exported, stored, tmp_path, name, order) -> None:
    image = sitk.DICOMOrient(sitk.ReadImage(str(exported("v.mha"))), order)
    sitk.WriteImage(image, str(tmp_path / name), useCompression=name != "t.nii")
    assert_same(tmp_path / name, stored)


@pytest.mark.parametrize("forms", ["sform", "qform"])
def test_nibabel_s_frames_types_and_scales(exported, stored, tmp_path, forms) -> None:
    first = nibabel.as_closest_canonical(nibabel.load(exported("v.nii")))
    image = nibabel.Nifti1Image(first.get_fdata(), first.affine)
    image.header.set_data_dtype(np.int16)  # scl_slope, scl_inter
    image.header.set_xyzt_units("mm")
    image.set_sform(first.affine, code=int(forms == "sform"))
    image.set_qform(first.affine, code=int(forms == "qform"))
    nibabel.save(image, tmp_path / "t.nii")
    assert_same(tmp_path / "t.nii", stored, atol=0.09 / 32767)


@pytest.mark.parametrize("order", ["RAS", "PIL"])
def test_the_sform_alone_states_sizes_that_pixdim_does_not(exported, stored, tmp_path, order) -> None:
    first = nibabel.as_closest_canonical(nibabel.load(exported("v.nii")))
    image = first.as_reoriented(nibabel.orientations.axcodes2ornt(order))
    image.header["pixdim"][1:4], image.header["qform_code"], image.header["sform_code"] = 1, 0, 2
    nibabel.save(image, tmp_path / "t.nii")
    assert_same(tmp_path / "t.nii", stored)
    image.header["qform_code"] = 1
    nibabel.save(image, tmp_path / "t.nii")
    with pytest.raises(InputError, match=r"t.nii: voxel sizes: found .* by the sform and \[1.0, 1.0, 1.0\] by the qform"):
        load_volume(tmp_path / "t.nii")


def test_nrrd_s_detached_header_and_the_half_of_a_pair(exported, stored, tmp_path) -> None:
    sitk.WriteImage(sitk.ReadImage(str(exported("v.mha"))), str(tmp_path / "t.nhdr"))
    assert_same(tmp_path / "t.nhdr", stored)
    text = (tmp_path / "t.nhdr").read_text()
    (tmp_path / "t.nhdr").write_text(re.sub("data ?file: .*", "data file: /etc/passwd", text))
    with pytest.raises(InputError, match="inside the folder"):
        load_volume(tmp_path / "t.nhdr")
    nibabel.save(nibabel.load(exported("v.nii")), tmp_path / "t.hdr")
    with pytest.raises(InputError, match=r"numbers in another file, .* \(.hdr\), which is not read; .* as one file"):
        load_volume(tmp_path / "t.hdr")


def replaced(old: str, new: str):
    return lambda data: re.sub(old.encode("latin-1"), new.encode("latin-1"), data, count=1)


def field(offset: int, kind: str, value: float):
    """A NIfTI header with one number changed."""
    word = np.array(value, kind).tobytes()
    return lambda data: data[:offset] + word + data[offset + len(word) :]


WRONG = {
    "v.mha": [
        replaced("DimSize = 7", "DimSize = 70000000"), replaced("Matrix = 1 0 0 0 1 0", "Matrix = 0.8 0.6 0 -0.6 0.8 0"),
        replaced("ElementSpacing = 1.25", "ElementSpacing = 0"), replaced("Offset = -?[0-9.]+", "Offset = 1e11"),
    ],
    "v.nii": [
        field(42, "<i2", 32000), lambda data: field(48, "<i2", 9)(field(40, "<i2", 4)(data)), field(70, "<i2", 128),
        field(280, "<f4", np.nan),
    ],
    "v.nrrd": [
        replaced("encoding: raw", "encoding: bzip2"), replaced("endian: little", "data file: /etc/passwd"),
        replaced("left-posterior-superior", "scanner-xyz"), replaced("endian:", 'space units: "furlong"\nendian:'),
        replaced("sizes: 7", "sizes: 7000000"), lambda data: data[:-4] + np.float32(np.nan).tobytes(),
    ],
    "v.npy": [lambda data: b"\x80\x04K\x01."],
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_file_is_one_line(exported, name) -> None:
    """Counts, axes, directions, units and types that no reader may take; cut files: tests/importers/test_fuzz.py."""
    for number, damage in enumerate(WRONG[name]):
        (path := exported(name)).write_bytes(damage(path.read_bytes()))
        with pytest.raises(InputError) as caught:
            load_volume(path)
        assert name in str(caught.value) and "\n" not in str(caught.value), number


def test_a_grid_beside_an_array_must_be_its_own(exported) -> None:
    path = exported("v.npy")
    good = json.loads(path.with_suffix(".json").read_text())
    for key, value in (("shape", [1, 2, 3]), ("voxel_size_mm", [1, 2, "x"])):
        path.with_suffix(".json").write_text(json.dumps({**good, key: value}))
        with pytest.raises(InputError, match=f"json.*{key}"):
            load_volume(path)
