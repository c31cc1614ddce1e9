"""Scanners whose sample turns: their files against geometry by hand, and their pixels."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import laboratory_of_importers as lab
import numpy as np
import pytest
from conftest_of_importers import WORLD_POINTS, pose_at, projected

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, PoseTable
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan, recognise

pytestmark = pytest.mark.slow
CENTRED = ConeGeometry(500.0, 800.0, (10, 14), (3.0, 2.5))
WRITERS: dict[str, tuple[Callable[..., Path], ConeGeometry]] = {
    "nikon": (lab.write_nikon, CENTRED),
    "skyscan": (lab.write_skyscan, ConeGeometry(512.0, 1024.0, (10, 14), (2.5, 2.5), (2.5, 0.0))),
    "zeiss": (lab.write_zeiss, ConeGeometry(512.0, 1024.0, (10, 14), (2.5, 2.5))),
    "flexray": (lab.write_flexray, ConeGeometry(500.0, 800.0, (10, 14), (2.5, 2.5), (4.0, -6.0))),
}


@pytest.mark.parametrize("form", WRITERS)
def test_pixels_and_geometry_are_those_of_the_scan_that_was_written(tmp_path, make_truth, assert_same, form) -> None:
    """For a turning sample the times come from the options."""
    writer, geometry = WRITERS[form]
    truth = make_truth(geometry=geometry)
    path = writer(tmp_path / form, truth)
    assert recognise(path) == form
    assert_same(scan := import_scan(path), truth, grid=False, pixels=1e-3)
    assert isinstance(scan.trajectory, CircularOrbit)
    np.testing.assert_array_equal(scan.projections, lab.line_integrals_of(lab.counts16(truth)))
    fly = make_truth(fly=True, direction=-1, geometry=geometry)
    options = ImportOptions(exposure_s=0.4, fps=0.8, readout_ms=300.0, first="top")
    assert_same(import_scan(writer(tmp_path / "fly", fly), options), fly, grid=False, pixels=1e-3)


def falls_where(scan: Any, angle_rad: np.ndarray, geometry: Any, share: float = 0.5, **stage: float) -> None:
    """Compares the imported poses with the room's own geometry, frame by frame."""
    for frame, angle in enumerate(angle_rad):
        expected = lab.lab_pixels(WORLD_POINTS, angle, geometry, **stage)
        np.testing.assert_allclose(projected(pose_at(scan, frame, share), WORLD_POINTS), expected, atol=1e-6)


def test_nikon_s_axis_is_offset_and_leans(tmp_path, make_truth, caplog) -> None:
    """ObjectOffsetX moves it to the left; without it the two places on the panel say where it is, and how it leans. CIL has
    the panel at (−DetectorOffsetX, DetectorOffsetY), x to the right seen from the source."""
    truth = make_truth(geometry=CENTRED)
    path = lab.write_nikon(tmp_path / "a", truth, ObjectOffsetX=2.5, ObjectRoll=1.5, ObjectTilt=-0.8)
    scan = import_scan(path)
    assert isinstance(scan.trajectory, PoseTable) and scan.geometry.detector_shape == (10, 14)
    leaning = {"axis_mm": -2.5, "roll_rad": np.deg2rad(1.5), "tilt_rad": np.deg2rad(-0.8)}
    falls_where(scan, truth.angle_rad, CENTRED, **leaning)
    ends = {"ObjectOffsetX": None, "ObjectRoll": None, "CentreOfRotationTop": 5.0, "CentreOfRotationBottom": 2.0}
    scan = import_scan(lab.write_nikon(tmp_path / "b", truth, **ends))
    falls_where(scan, truth.angle_rad, CENTRED, axis_mm=-3.5 / 1.6, roll_rad=-np.arctan(3 / 30))
    fly = import_scan(path, ImportOptions(exposure_s=0.4, fps=0.8))
    falls_where(fly, truth.angle_rad, CENTRED, 0.0, **leaning)  # as its exposure starts
    offsets = {"DetectorOffsetX": 4.5, "DetectorOffsetY": -2, "ObjectOffsetX": 1.5}
    scan = import_scan(path := lab.write_nikon(tmp_path / "d", truth, **offsets))
    falls_where(scan, truth.angle_rad, replace(CENTRED, detector_offset_mm=(-2.0, -4.5)), axis_mm=-1.5)
    scan = import_scan(path, ImportOptions(detector_offset_mm=(1.0, 2.0)))
    assert scan.geometry.detector_offset_mm == pytest.approx((1.0, 2.0)) and not caplog.text.count("ObjectOffsetX")
    path = lab.write_nikon(tmp_path / "c", truth, ObjectOffsetX=None, InitialAngle=None, DetectorOffsetY=3)
    import_scan(path)
    assert "scan.xtekct: no ObjectOffsetX (the axis in the middle: detector_offset_mm, or calibrate)" in caplog.text
    assert "no InitialAngle (0)" in caplog.text and "DetectorOffsetY 3: the panel's middle is 0 mm" in caplog.text


def test_nikon_s_frames_may_lie_in_a_folder_of_their_own(tmp_path, make_truth) -> None:
    """A folder on the scanner's own disk is not looked for."""
    for number, name in enumerate(("frames", "/scans/mine", r"\\server\scans", r"C:\scans\mine", "inner")):
        path = lab.write_nikon(tmp_path / str(number), make_truth(geometry=CENTRED), InputFolderName=name)
        if name in ("frames", "inner"):
            (path / name).mkdir()
            for file in path.glob("*.tif") if name == "frames" else ():
                file.rename(path / "frames" / file.name)
        if name != "inner":
            assert import_scan(path).frames == 6
    with pytest.raises(InputError, match="Projections: found 0 files"):
        import_scan(path)


def test_skyscan_s_pixels_are_not_square_and_its_sample_turns_either_way(tmp_path, make_truth, caplog) -> None:
    geometry = ConeGeometry(500.0, 800.0, (10, 14), (3.0, 2.5), (4.0, 0.0))
    truth = make_truth(geometry=geometry)
    lines = {"Image Rotation": 0.17, "Reference Intensity": None, "Random Movement": "OFF (30)"}
    path = lab.write_skyscan(tmp_path / "a", truth, **lines)
    scan = import_scan(path)
    falls_where(scan, truth.angle_rad, geometry)
    assert scan.geometry.pixel_size_mm == pytest.approx((3.0, 2.5))
    for text in ("(air at 65535 counts; else say flat_value)", "Image Rotation is 0.17°", "check --fix-offset"):
        assert text in caplog.text
    assert not any(text in caplog.text for text in ("STEP", "an exposure", "Random Movement"))
    other = {"Rotation Direction": "CC", "Type of Detector Motion": None, "Random Movement": "ON (10)"}
    scan = import_scan(lab.write_skyscan(tmp_path / "b", truth, **other))
    falls_where(scan, -truth.angle_rad, geometry)
    assert "an exposure of 0.4 s and no time from frame to frame" in caplog.text  # two frames of 200 ms
    assert "Random Movement is ON (10): the log states no shifts" in caplog.text
    fly = import_scan(path, ImportOptions(fps=0.8, flat_value=lab.WHITE))
    assert fly.is_fly and fly.shutter.exposure_s == 0.4
    np.testing.assert_array_equal(fly.projections, lab.line_integrals_of(lab.counts16(truth)))


def test_what_a_skyscan_s_log_says_and_is_not_used_is_named(tmp_path, make_truth, caplog) -> None:
    truth = make_truth(geometry=ConeGeometry(500.0, 800.0, (10, 14), (3.0, 2.5), (4.0, 0.0)))
    fine = {"Camera Pixel Size (um)": 1250.0, "Camera binning": "2x2", "Number of connected scans": 1}
    import_scan(lab.write_skyscan(tmp_path / "a", truth, **fine))
    assert not re.search("Camera|connected|Postalignment|never stopped", caplog.text)
    odd = {"Camera Offset": "ON", "Number of connected scans": 3, "Camera Pixel Size (um)": 4000.0}
    odd |= {"Type of Detector Motion": "CONTINUOUS", "Suggested HU": "1\n[Reconstruction]\nPostalignment=-1.50"}
    import_scan(lab.write_skyscan(tmp_path / "b", truth, **odd))
    for words in (
        r"0.4 s and a sample that never stopped \(CONTINUOUS\), .* at rest; say", "is ON: only the images of this log",
        "Number of connected scans is 3: only", "where the camera's pixels are 4 mm: else say pixel_size_mm",
        "not by Postalignment, -1.50, whose sign",
    ):
        assert re.search(words, caplog.text)


def test_zeiss_s_reference_of_another_exposure_is_scaled(tmp_path, make_truth, caplog) -> None:
    truth, usual = make_truth(geometry=CENTRED), np.float32([0.5] * 6)
    for flat_s, words in ((0.125, "that of the images 0.5 s"), (0.5, "")):
        white = np.full(CENTRED.detector_shape, lab.WHITE * flat_s / 0.5, np.float32)
        streams = {"ReferenceData/Image": white, "ReferenceData/ExpTime": np.float32(flat_s), "ImageInfo/ExpTimes": usual}
        scan = import_scan(lab.write_zeiss(tmp_path / f"{flat_s}", truth, **streams))
        np.testing.assert_allclose(scan.projections, truth.scan.projections, atol=2e-4)
        assert words in caplog.text and ("txrm2tiff" in caplog.text) == bool(words)
        caplog.clear()


def test_flexray_s_tube_stage_and_panel_stand_anywhere(tmp_path, make_truth, caplog) -> None:
    """Places are in one frame; a window lower on the panel is as flexdata has it."""
    geometry = ConeGeometry(500.0, 800.0, (10, 14), (2.5, 2.5))
    places = {"ver_tube": 1.0, "tra_tube": -2.0, "ver_det": 6.5, "tra_det": 3.25, "tra_obj": -0.5}
    window = {"ROI (LTRB)": "10, 20, 1953, 1555", "Exposure time (ms)": 100, "Number of averages": 3}
    truth = make_truth(geometry=geometry)
    path = lab.write_flexray(tmp_path / "a", truth, **places, **window)
    scan = import_scan(path / "scan settings.txt")
    moved = replace(geometry, detector_offset_mm=(6.5 - 1.0 + 20 * 0.0748, 3.25 + 2.0 + 10 * 0.0748))
    falls_where(scan, truth.angle_rad, moved, axis_mm=1.5)
    assert "without a correction profile of flexdata" in caplog.text and "(0)" not in caplog.text
    assert "the 2 flats count as of one time; say flats time if the second half" in caplog.text
    assert import_scan(path, ImportOptions(fps=1.0)).shutter.exposure_s == pytest.approx(0.3)
    bare = {"Binned pixel size": None, "tra_obj": None, "ROI (LTRB)": None, "Start angle": None}
    scan = import_scan(lab.write_flexray(tmp_path / "b", truth, **bare))
    falls_where(scan, np.deg2rad(np.linspace(0, 135, 6)), geometry)
    assert "no tra_obj (0), no Start angle (0), no ROI (LTRB) (the whole panel)" in caplog.text


@pytest.mark.parametrize(("binned_mm", "is_doubted"), [(2.515, False), (2.54, True), (1.25, True), (10.0, True)])
def test_flexray_s_voxel_size_comes_before_another_pixel_size(tmp_path, make_truth, caplog, binned_mm, is_doubted) -> None:
    truth = make_truth(geometry=ConeGeometry(500.0, 800.0, (10, 14), (2.5, 2.5)))
    path = lab.write_flexray(tmp_path / "a", truth, **{"Binned pixel size": binned_mm})
    for options in (ImportOptions(), ImportOptions(source_to_axis_mm=400.0)):
        size_mm = import_scan(path, options).geometry.pixel_size_mm
        assert size_mm == pytest.approx([2.5 if is_doubted else binned_mm] * 2)
    said = f"Binned pixel size {binned_mm:g} mm is not used, as Voxel size makes it 2.5 mm; say pixel_size_mm"
    assert caplog.text.count(said) == 2 * is_doubted
    assert import_scan(path, ImportOptions(pixel_size_mm=1.5)).geometry.pixel_size_mm == (1.5, 1.5)


def test_zeiss_s_images_and_references_of_several_exposures(tmp_path, make_truth, caplog) -> None:
    """Those of ReferenceData come first. Exposures may differ between references and between images."""
    truth, flat_s, frame_s = make_truth(geometry=CENTRED), np.float32([0.25, 2, 0.5]), np.float32([1, 0.5, 1, 2, 0.5, 1])
    white = np.full(CENTRED.detector_shape, lab.WHITE, np.float32)
    several = {f"MultiReferenceData/Image{i + 1}": white * seconds for i, seconds in enumerate(flat_s)}
    several["MultiReferenceData/ExpTime"] = flat_s
    one = {"ReferenceData/Image": white * 4, "ReferenceData/ExpTime": np.float32(4)}
    counts = lab.counts16(truth).astype(np.float32) * frame_s[:, None, None]
    longer = {f"ImageData1/Image{i + 1}": image for i, image in enumerate(counts)} | {"ImageInfo/DataType": np.int32(10)}
    longer["ImageInfo/ExpTimes"] = np.float32([*frame_s, 0])  # there is room for one image more
    every_second = {"ImageInfo/ExpTimes": np.float32([1])}
    none = {"ReferenceData/Image": None}
    dimmer = {name: values * 0.9 for name, values in several.items() if "Image" in name}
    for i, streams in enumerate((none | several | every_second, one | several | dimmer | longer, none | several | longer)):
        caplog.clear()
        scan = import_scan(lab.write_zeiss(tmp_path / f"{i}", truth, **streams))
        np.testing.assert_allclose(scan.projections, truth.scan.projections, atol=2e-4)
        assert ("ExpTimes: 0.5 to 2 s: each image is divided by its own" in caplog.text) == (i > 0)
    integrals = {name: values / 10000 if name.startswith("ImageData") else values for name, values in longer.items()}
    scan = import_scan(lab.write_zeiss(tmp_path / "p", truth, **integrals), ImportOptions(quantity="attenuation"))
    np.testing.assert_allclose(scan.projections, counts / 10000, rtol=1e-6)


def test_zeiss_s_shifts_move_the_panel(tmp_path, make_truth, caplog) -> None:
    """An image that is to be moved to the right by a column was taken by a panel a column further to the left."""
    geometry = ConeGeometry(512.0, 1024.0, (10, 14), (2.5, 2.5))
    truth = make_truth(geometry=geometry)
    shifts = {"Alignment/X-Shifts": [0, 1, -2, 0.5, 0, 0, 9], "Alignment/Y-Shifts": [0, 0, 0, -1.5, 2, 0, 9]}
    streams = {name: np.float32(values) for name, values in shifts.items()}
    path = lab.write_zeiss(tmp_path / "a", truth, **streams, **{"ReconSettings/CenterShift": np.float32(3.5)})
    scan = import_scan(path)
    for frame, (columns, rows) in enumerate(zip(*shifts.values(), strict=True)):
        if frame < 6:
            expected = lab.lab_pixels(WORLD_POINTS, truth.angle_rad[frame], geometry) - [rows, columns]
            np.testing.assert_allclose(projected(pose_at(scan, frame, 0.5), WORLD_POINTS), expected, atol=1e-4)
    assert "ReconSettings/CenterShift is 3.5 pixels and not used" in caplog.text and "no Alignment" not in caplog.text
    streams = {"ImageInfo/XrayGeometry": None, "Alignment/X-Shifts": None, "ReferenceData/Image": None}
    path = lab.write_zeiss(tmp_path / "b", truth, **streams, **{"ImageInfo/ExpTimes": np.float32([0.5] * 6)})
    with pytest.raises(InputError, match="flats: found none; .* say flat_value"):
        import_scan(path)
    fly = import_scan(path, ImportOptions(flat_value=lab.WHITE, fps=0.8))
    assert fly.shutter.exposure_s == 0.5 and fly.is_fly
    assert "no Alignment/X-Shifts (0), no ImageInfo/XrayGeometry (a cone)" in caplog.text
    assert "parallel" not in caplog.text
    flat = lab.write_zeiss(tmp_path / "c", truth, **{"ImageInfo/XrayGeometry": np.int32(2)})
    assert import_scan(flat).geometry.pixel_size_mm == (1.25, 1.25)
    assert "ImageInfo/XrayGeometry is 2: a parallel beam, so ImageInfo/StoRADistance and" in caplog.text


def test_a_zeiss_file_with_images_in_two_folders_and_in_float(tmp_path, make_truth) -> None:
    """A hundred images a folder; images of 4096 bytes or more lie in sectors of their own."""
    images = {f"ImageData{i // 100 + 1}/Image{i + 1}": np.full((40, 60), i / 16, np.float32) for i in range(102)}
    facts = {
        "ImageHeight": np.int32(40), "ImageWidth": np.int32(60),
        "NoOfImages": np.int32(102), "DataType": np.int32(10), "Angles": np.arange(102, dtype=np.float32),
        "StoRADistance": np.full(102, 500, np.float32), "DtoRADistance": np.full(102, 300, np.float32),
    }  # fmt: skip
    streams = {f"ImageInfo/{name}": value for name, value in facts.items()} | images
    without = {"Alignment/X-Shifts": None, "Alignment/Y-Shifts": None, "ReferenceData/Image": None}
    path = lab.write_zeiss(tmp_path / "a", make_truth(geometry=CENTRED), **streams, **without)
    scan = import_scan(path, ImportOptions(quantity="attenuation"))
    np.testing.assert_array_equal(scan.projections[:, 3, 4], np.arange(102) / 16)


WRONG = {
    "nikon": [
        ("AngularStep", 0), ("Units", "cm"), ("ObjectOffsetX", 100), ("WhiteLevel", None), ("DetectorPixelsX", 50),
        ("Projections", 7), ("SrcToObject", "far"), ("SrcToDetector", 7), ("WhiteLevel", "6e4\nWhiteLevel=5e4"),
    ],
    "skyscan": [
        ("Filename Prefix", None), ("Number Of Files", 9), ("Number Of Rows", 99), ("Scanning Trajectory", "SPIRAL"),
        ("Rotation Direction", "XX"), ("Exposure (ms)", -3), ("Frame Averaging", "ON (x)"), ("Optical Axis (line)", 4000),
        ("Reference Intensity", 900), ("Flat Field Correction", "OFF"), ("Camera to Source (mm)", 3),
    ],
    "flexray": [("SDD", None), ("SDD", 3), ("Last angle", 10.0), ("Binned pixel size", "none"), ("ROI (LTRB)", "0,0,1943")],
    "zeiss": [
        ("ImageInfo/NoOfImages", np.int32(10**9)), ("ImageData1/Image5", None), ("ImageData1/Image4", np.zeros(99, "<u2")),
        ("ImageInfo/DataType", np.int32(7)), ("ImageInfo/Angles", np.zeros(6, "<f4")),
        ("ImageInfo/StoRADistance", np.float32([500, 510] * 3)), ("ImageInfo/ExpTimes", np.float32([-3] * 6)),
        ("Alignment/X-Shifts", np.ones(2, "<f4")), ("ReferenceData/Image", np.ones(70, "<f4")),
    ],
}  # fmt: skip


@pytest.mark.parametrize("form", WRONG)
def test_wrong_fields_are_named_as_the_file_names_them(tmp_path, make_truth, form) -> None:
    """Not as options that nobody gave."""
    writer, geometry = WRITERS[form]
    truth = make_truth(geometry=geometry)
    for number, (line, value) in enumerate(WRONG[form]):
        with pytest.raises(InputError) as caught:
            import_scan(writer(tmp_path / str(number), truth, **{line: value}), form=form)
        said = str(caught.value)
        assert said.startswith(str(tmp_path)) and line.lower() in said.lower() and "\n" not in said, (line, value, said)
