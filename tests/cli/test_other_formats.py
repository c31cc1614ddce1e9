"""Volumes and scans in other programs' formats at the commands that read them."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import SimpleITK as sitk

from phyradgs_cl.api import compare, load_scan, simulate
from phyradgs_cl.exporters import export_volume
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers import load_volume
from phyradgs_cl.io import write_scan, write_volume

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("fast_pictures")]
FORMATS = {"v.mha": "mha", "v.nii.gz": "nii", "v.nrrd": "nrrd", "v.npy": "npy", "v.tif": "tiff"}


@pytest.fixture
def files(rt, tmp_path) -> tuple[Path, Path, np.ndarray, Grid]:
    """A scan with its truth, and a volume that differs from it in a known way."""
    scan = simulate("jaw", size=12, detector=12, views=4, device=rt)
    volume = (scan.reference + 0.01).astype(np.float32)
    write_scan(tmp_path / "scan.h5", scan)
    write_volume(tmp_path / "v.h5", volume, scan.grid, {"method": "fdk", "seconds": 2.5})
    return tmp_path / "scan.h5", tmp_path / "v.h5", volume, scan.grid


def test_evaluate_has_one_answer_for_all_formats(told, files, tmp_path) -> None:
    scan, volume, *_ = files
    answers = {}
    for path in (volume, *(export_volume(volume, to, tmp_path / name) for name, to in FORMATS.items())):
        facts = told("evaluate", path, "--reference", scan, "--json")
        assert facts["compared"] == "voxel by voxel"
        answers[path.name] = {key: facts[key] for key in ("psnr_db", "ssim", "method") if key in facts}
        picture = "v.evaluated.png" if path == volume else f"{path.name}.evaluated.png"  # one each, for volumes of one name
        assert facts["picture"] == str(tmp_path / picture) and (tmp_path / picture).exists()
    assert answers.pop("v.h5") == {**answers["v.mha"], "method": "fdk"}
    assert all(answer == answers["v.mha"] for answer in answers.values())
    assert told("evaluate", volume, "--reference", tmp_path / "v.mha", "--json")["ssim"] == 1
    said = told("info", tmp_path / "v.nii.gz")
    assert "volume (NIfTI)" in said and "(12, 12, 12)" in said and "voxel size mm" in said
    told("simulate", "--volume", tmp_path / "v.nrrd", "--size", 6, "--detector", 8, "--views", 3, "-o", tmp_path / "s.h5")
    assert "v.nrrd" in load_scan(tmp_path / "s.h5").title


def test_evaluate_converts_a_reference_in_hounsfield_units_or_refuses_it(told, refused, files, tmp_path) -> None:
    _, volume, values, grid = files
    truth, water_per_mm = values - 0.01, 0.019
    write_volume(tmp_path / "truth.h5", truth, grid, {})
    write_volume(tmp_path / "hu.h5", 1000 * (truth / water_per_mm - 1), grid, {})
    with h5py.File(tmp_path / "hu.h5", "r+") as file:
        del file["entry/reconstruction/volume"].attrs["units"]  # a file that states a unit is taken at its word
    words = ["evaluate", volume, "--json", "--reference"]
    plain = told(*words, tmp_path / "truth.h5")
    converted = told(*words, tmp_path / "hu.h5", "--mu-water-per-mm", water_per_mm)
    assert converted["psnr_db"] == pytest.approx(plain["psnr_db"], abs=1e-3)
    assert converted["ssim"] == pytest.approx(plain["ssim"], abs=1e-4)
    refused([*words, tmp_path / "hu.h5"], "hu.h5: found values from -1000 to", "--mu-water-per-mm")
    refused([*words, tmp_path / "hu.h5", "--mu-water-per-mm", "0"], "--mu-water-per-mm: found 0")
    wanted = "expected a volume in Hounsfield units that does not state its scale"
    refused([*words, tmp_path / "truth.h5", "--mu-water-per-mm", "0.019"], wanted)


def test_a_result_in_hounsfield_units_is_converted_once(told, refused, files, tmp_path) -> None:
    """By the scale that an export notes, and of other programs by water's attenuation; the line says so."""
    scan, volume, values, _ = files
    noted, bare = tmp_path / "noted.nii", tmp_path / "bare.nii"
    told("export", volume, "-o", noted, "--mu-water-per-mm", "0.002")
    image = sitk.ReadImage(str(noted))
    (without_note := sitk.GetImageFromArray(sitk.GetArrayFromImage(image))).SetSpacing(image.GetSpacing())
    without_note.SetOrigin(image.GetOrigin())
    sitk.WriteImage(without_note, str(bare))
    ways = ((volume,), (noted,), (bare, "--mu-water-per-mm", "0.002"))
    answers = [told("evaluate", *way, "--reference", scan, "--json") for way in ways]
    assert answers[0]["compared"] == "voxel by voxel"
    assert answers[1]["compared"] == "voxel by voxel, noted.nii from HU (water 0.002, air 0 1/mm)"
    assert all(answer["psnr_db"] == pytest.approx(answers[0]["psnr_db"], abs=1e-3) for answer in answers)
    refused(["evaluate", bare, "--reference", scan], "as of Hounsfield units", "--mu-water-per-mm")
    start = ["reconstruct", scan, "--method", "sirt", "--iterations", "1", "-o", tmp_path / "r.h5"]
    assert "first volume: noted.nii from HU (water 0.002" in told(*start, "--initial", noted)
    refused([*start, "--initial", bare], "bare.nii: found values from", "--mu-water-per-mm")
    refused([*start, "--mu-water-per-mm", "0.02"], "--mu-water-per-mm: given without --initial")
    refused([*start, "--initial", volume, "--mu-water-per-mm", "0.02"], "expected a volume in Hounsfield units")
    assert load_volume(noted).values == pytest.approx(values, abs=1e-6)


def test_export_fits_hounsfield_units_and_says_so(told, refused, files, tmp_path) -> None:
    _, volume, values, grid = files
    box = np.full(grid.shape, 0.001)
    box[3:9, 3:9, 3:9] = 0.02
    write_volume(tmp_path / "box.h5", box, grid, {})
    words = ["export", tmp_path / "box.h5", "--hu", "-o"]
    said = told(*words, tmp_path / "box.nii")
    assert "air 0.001 ± " in said and "(1512 voxels of the lowest peak), water 0.02 ± " in said and "(216 voxels" in said
    hu = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "box.nii")))
    np.testing.assert_allclose([hu.min(), hu.max()], [-1000, 0], atol=0.01)
    refused([*words, tmp_path / "x.nii", "--mu-water-per-mm", "0.02"], "one of the two")
    refused(["export", volume, "-o", tmp_path / "x.ply", "--insert-hu", "40"], "--hu: given with --to ply")
    refused([*words, tmp_path / "x.nii", "--air-mm", "1,2"], "--air-mm: found shape (2,)")
    assert not (tmp_path / "x.nii").exists()


def test_boxes_with_little_in_common_are_warned_of(told, files, tmp_path, caplog) -> None:
    scan, volume, values, grid = files
    small, aside = (Grid(grid.shape, tuple(factor * side for side in grid.voxel_size_mm), offset) for factor, offset in (
        (0.7, grid.offset_mm), (1.0, (0.0, 0.0, 0.4 * grid.size_mm[2])),
    ))  # fmt: skip
    for name, other, first, second in (("small", small, 100, 34.3), ("aside", aside, 60, 60)):
        caplog.clear()
        write_volume(tmp_path / f"{name}.h5", values, other, {}, doubt=np.ones_like(values))
        told("evaluate", tmp_path / f"{name}.h5", "--reference", scan)
        said = caplog.text.count(f"share {first} % of the first box and {second} % of the second")
        assert said == (min(first, second) < 50), (name, caplog.text)
    caplog.clear()
    part = grid.part((2, 3, 2), (5, 5, 5))
    write_volume(tmp_path / "part.h5", np.full((5, 5, 5), 0.1, np.float32), part, {})  # a region of interest, and a bad one
    told("evaluate", tmp_path / "part.h5", "--reference", scan)
    assert "of the first box" not in caplog.text


def test_how_another_grid_is_compared_is_said_in_the_line_and_the_json(told, refused, files, tmp_path) -> None:
    scan, _, volume, grid = files
    dz, dy, dx = grid.voxel_size_mm
    fine = Grid((24, 24, 24), (dz / 2, dy / 2, dx / 2), grid.offset_mm)
    half = Grid((6, 12, 12), grid.voxel_size_mm, (grid.offset_mm[0] - 3 * dz, *grid.offset_mm[1:]))
    for name, values, other, share, words in (
        ("fine.h5", np.kron(volume, np.ones((2, 2, 2))), fine, 1, "24×24×24 voxels"),
        ("half.h5", volume[:6], half, 0.5, "voxel by voxel, on 50 % of the reference"),
    ):
        write_volume(tmp_path / name, values, other, {})
        command = ["evaluate", tmp_path / name, "--reference", scan]
        assert words in (line := told(*command)) and line.count("\n") == 1
        facts = told(*command, "--json")
        assert facts["share_of_reference_covered"] == share and words.split()[0] in facts["compared"]
    truth = load_scan(scan).reference
    assert truth[0, 0, 0] == 0 and facts["psnr_db"] == pytest.approx(compare(volume[:6], truth[:6])["psnr_db"])
    write_volume(tmp_path / "air.h5", volume[:1, :1, :1], grid.part((0, 0, 0), (1, 1, 1)), {})
    refused(["evaluate", tmp_path / "air.h5", "--reference", scan], "nothing in the 0.0579 % of it that lie in")
    write_volume(tmp_path / "away.h5", volume, replace(grid, offset_mm=(0.0, 0.0, 1e3)), {})
    refused(["evaluate", tmp_path / "away.h5", "--reference", scan], "no voxel of the reference", "(1000, 0, 0)")
    assert not (tmp_path / "away.evaluated.png").exists()


def test_volumes_of_rtk_turn_about_y(told, files, tmp_path) -> None:
    scan, _, volume, grid = files
    inner = [3, 4, 1], [5, 6, 8]
    part = grid.part(*inner)
    start, stop = inner[0], np.add(*inner)
    truth = load_scan(scan).reference[tuple(map(slice, start, stop))]
    image = sitk.GetImageFromArray(truth.transpose(2, 0, 1))  # RTK's (z, y, x) are our (x, z, y)
    z, y, x = part.voxel_size_mm
    image.SetSpacing((y, z, x))
    lowest = [c - (n - 1) / 2 * v for c, n, v in zip(part.offset_mm, part.shape, part.voxel_size_mm, strict=True)]
    image.SetOrigin((lowest[1], lowest[0], lowest[2]))
    sitk.WriteImage(image, str(tmp_path / "rtk.mha"))
    write_volume(tmp_path / "inner.h5", volume[tuple(map(slice, start, stop))], part, {})
    found = told("evaluate", tmp_path / "inner.h5", "--reference", tmp_path / "rtk.mha", "--json", "--rtk-reference")
    assert found["compared"] == "voxel by voxel"
    assert found["psnr_db"] == pytest.approx(20 * np.log10(truth.max() / 0.01), abs=1e-3)


def test_a_reference_without_a_scale_is_placed_or_refused(told, refused, files, tmp_path) -> None:
    """As many voxels do not make it the same box."""
    scan, volume_file, volume, grid = files
    truth, side_mm = load_scan(scan).reference, grid.voxel_size_mm[0]
    write_volume(tmp_path / "inner.h5", volume[3:9, 3:9, 3:9], grid.part((3, 3, 3), (6, 6, 6)), {})
    for name, values in (("bare.h5", truth), ("same_count.h5", truth[::2, ::2, ::2])):
        with h5py.File(tmp_path / name, "w") as file:
            file["volume"] = values
    command = ["evaluate", tmp_path / "inner.h5", "--reference"]
    refused([*command, tmp_path / "same_count.h5"], "same_count.h5: found voxels without a scale", "--reference-voxel-mm")
    sides = ["--reference-voxel-mm", f"{side_mm!r}"]
    found = told(*command, tmp_path / "bare.h5", *sides, "--json")
    assert found["psnr_db"] == pytest.approx(told(*command, scan, "--json")["psnr_db"], abs=1e-6)
    refused([*command, scan, *sides], "--reference-voxel-mm", "expected a reference without a scale")
    refused([*command, tmp_path / "bare.h5", "--reference-voxel-mm", "-1"], "--reference-voxel-mm: found")
    export_volume(volume_file, "npy", tmp_path / "plain.npy")
    (tmp_path / "plain.json").unlink()
    assert "voxel by voxel, as plain.npy has no scale" in told("evaluate", tmp_path / "plain.npy", "--reference", scan)
