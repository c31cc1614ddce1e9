"""Raw projections, read by the package itk-rtk, where it is installed (conftest.py), and written here as Elekta, Varian and
medPhoton write them, in the layouts that RTK's readers state. ``AIR`` are the counts that RTK takes for air."""

import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan, recognise

RIM = 4  # pixels that RTK cuts off each side of Elekta's images
AIR = {"his": 65536, "hnd": 139000, "hnc": 65535, "xim": 139000}
TABLE_CM, ALONG_CM = -2.0, 1.5  # where medPhoton's ring stood: RTK takes them from the places


def frames_of(truth: Any) -> list[tuple[float, np.ndarray]]:
    """The gantry's angle in degrees and line integrals (v, u), frame by frame."""
    angles_deg = np.rad2deg(truth.angle_rad).round(9).tolist()
    return list(zip(angles_deg, truth.scan.projections.astype(np.float64), strict=True))


def counts(integrals: np.ndarray, air: float) -> np.ndarray:
    return np.round(air * np.exp(-integrals)).astype(np.int64)


def write_elekta(folder: Path, truth: Any) -> Path:
    """_Frames.xml with the panel's places, and .HIS images: 100 bytes of header, 65536 less the counts in 16 bits."""
    folder.mkdir()
    off_v, off_u = truth.scan.geometry.detector_offset_mm
    frames = []
    for i, (angle_deg, integrals) in enumerate(frames_of(truth), start=1):
        place = f"<GantryAngle>{angle_deg}</GantryAngle><UCentre>{-off_u}</UCentre><VCentre>{-off_v}</VCentre>"
        frames.append(f"<Frame><Seq>{i}</Seq>{place}</Frame>")
        rows, columns = (count + 2 * RIM for count in integrals.shape)
        header = bytearray(68)
        header[:4] = bytes([0, 112, 68, 0])
        struct.pack_into("<HHHHHH", header, 10, 32, 1, 1, rows, columns, 1)
        struct.pack_into("<H", header, 32, 4)
        image = np.zeros((rows, columns), np.uint16)
        image[RIM:-RIM, RIM:-RIM] = AIR["his"] - counts(integrals, AIR["his"])
        (folder / f"{i:05d}.his").write_bytes(bytes(header) + bytes(32) + image.astype("<u2").tobytes())
    text = f"<?xml version='1.0'?><ImageFrames><Frames>{''.join(frames)}</Frames></ImageFrames>"
    (folder / "_Frames.xml").write_text(text)
    return folder


def differences(image: np.ndarray) -> tuple[bytes, bytes]:
    """Varian's packing of an image (v, u): which of 1, 2 or 4 bytes each difference has, two bits for each; and the first
    row and a pixel in 4 bytes, then what each pixel differs by from left + below − below left."""
    flat, columns = image.astype(np.int64).ravel(), image.shape[1]
    i = np.arange(columns + 1, flat.size)
    steps = flat[i] - (flat[i - 1] + flat[i - columns] - flat[i - columns - 1])
    sizes = np.where(np.abs(steps) < 128, 0, np.where(np.abs(steps) < 32768, 1, 2))
    codes = np.zeros(4 * ((len(steps) + 3) // 4), np.uint8)
    codes[: len(sizes)] = sizes
    table = (codes.reshape(-1, 4) << np.array([0, 2, 4, 6], np.uint8)).sum(1).astype(np.uint8)
    pairs = zip(steps.tolist(), sizes.tolist(), strict=True)
    packed = b"".join(step.to_bytes(1 << size, "little", signed=True) for step, size in pairs)
    return table.tobytes(), flat[: columns + 1].astype("<u4").tobytes() + packed


def obi_header(shape: tuple[int, int], pitch_mm: tuple[float, float], angle_deg: float) -> bytes:
    """The header of .hnd and .hnc: words and numbers in a fixed order, of which RTK reads size, pitch and angle."""
    first = "<32sI4sI8s8s16sI16sI16sI", b"VARIAN_VA_INTERNAL_HNC_1.0"
    text = struct.pack(*first, 0, b"", 0, b"", b"", b"", 0, b"", 0, b"", 0)
    text += struct.pack("<IId16sIII4s", shape[1], shape[0], 0.0, b"RTIMAGE", 0, 0, 0, b"")
    numbers = np.zeros(40)
    numbers[[23, 24]] = pitch_mm[::-1]  # dIDUResolutionX, -Y
    numbers[33] = angle_deg  # dCTProjectionAngle
    return text + numbers.astype("<f8").tobytes()


def write_obi(folder: Path, truth: Any, suffix: str, fan: str = "HalfFan", below: str = "") -> Path:
    """ProjectionInfo.xml, and .hnd of packed differences or .hnc of 16 bits, there or below. The panel's place across is the
    sum of two in HalfFan, and the first of them alone in FullFan."""
    (folder / below).mkdir(parents=True)
    g = truth.scan.geometry
    off_v, off_u = g.detector_offset_mm
    lateral_mm = 40.0
    values = {
        "CalibratedSAD": g.source_to_axis_mm, "CalibratedSID": g.source_to_detector_mm, "FanType": fan,
        "CalibratedDetectorOffsetX": off_u - lateral_mm * (fan == "HalfFan"), "CalibratedDetectorOffsetY": off_v,
        "DetectorPosLat": lateral_mm, "DetectorSizeX": 400, "DetectorSizeY": 300, "GantryRtnSpeed": 6,
    }  # fmt: skip
    inner = "".join(f"<{name}>{value}</{name}>" for name, value in values.items())
    (folder / "ProjectionInfo.xml").write_text(f"<?xml version='1.0'?><ProjectionInfo>{inner}</ProjectionInfo>")
    for i, (angle_deg, integrals) in enumerate(frames_of(truth)):
        image, header = counts(integrals, AIR[suffix]), obi_header(integrals.shape, g.pixel_size_mm, angle_deg)
        if suffix == "hnc":
            body = header.ljust(512, b"\0") + image.astype("<u2").tobytes()
        else:
            body = header.ljust(1024, b"\0") + b"".join(differences(image))
        (folder / below / f"Proj_{i:05d}.{suffix}").write_bytes(body)
    return folder


def write_probeam(folder: Path, truth: Any) -> Path:
    """Scan.xml, and .xim of packed differences in Acquisitions/NUMBER/, each with the panel's place in cm and the source's
    angle, which turns against the gantry's."""
    (images := folder / "Acquisitions" / "733061622").mkdir(parents=True)
    g = truth.scan.geometry
    distances = f"<SAD>{g.source_to_axis_mm}</SAD><SID>{g.source_to_detector_mm}</SID>"
    (folder / "Scan.xml").write_text(f"<?xml version='1.0'?><Scan><Acquisitions>{distances}</Acquisitions></Scan>")
    off_v, off_u = g.detector_offset_mm
    for i, (angle_deg, integrals) in enumerate(frames_of(truth)):
        table, body = differences(counts(integrals, AIR["xim"]))
        rows, columns = integrals.shape
        facts = {
            "KVSourceRtn": 180.0 - angle_deg, "KVDetectorLat": off_u / 10, "KVDetectorLng": off_v / 10,
            "PixelHeight": g.pixel_size_mm[0] / 10, "PixelWidth": g.pixel_size_mm[1] / 10,
        }  # fmt: skip
        words = [struct.pack("<8sIIIIII", b"VMS.XI", 1, columns, rows, 32, 4, 1)]
        words += [struct.pack("<I", len(table)), table, struct.pack("<I", len(body)), body]
        words += [struct.pack("<III", 4 * rows * columns, 0, len(facts))]
        for name, value in facts.items():
            words.append(struct.pack(f"<I{len(name)}sId", len(name), name.encode(), 1, value))
        (images / f"Proj_{i:05d}.xim").write_bytes(b"".join(words))
    return folder


def write_ora(folder: Path, truth: Any) -> Path:
    """An .ora.xml for each MetaImage: places of source and panel, directions along rows and columns, and the transmission
    as slope × pixel + intercept. RTK's y is the axis of rotation, and z the source's direction at 0°."""
    folder.mkdir()
    g = truth.scan.geometry
    off_v, off_u = g.detector_offset_mm
    slope, intercept = 1 / 60000, 1e-3
    for i, (angle_deg, integrals) in enumerate(frames_of(truth)):
        angle_rad = np.deg2rad(angle_deg)
        right = np.array([np.cos(angle_rad), 0, -np.sin(angle_rad)])
        up, back = np.array([0.0, 1, 0]), np.array([np.sin(angle_rad), 0, np.cos(angle_rad)])
        shift, source = np.array([0, 10 * ALONG_CM, 10 * TABLE_CM]), back * g.source_to_axis_mm
        panel = source - back * g.source_to_detector_mm + right * off_u + up * off_v
        values = {
            "SourcePosition": " ".join(map(repr, (source + shift).tolist())),
            "Origin": " ".join(map(repr, (panel + shift).tolist())),
            "Direction": " ".join(map(repr, np.stack([right, up, back]).ravel().tolist())),
            "table_axis_distance_cm": TABLE_CM, "longitudinalposition_cm": ALONG_CM,
            "rescale_slope": slope, "rescale_intercept": intercept, "MHD_File": f"{i:05d}.mhd",
        }  # fmt: skip
        inner = "".join(f"<{name}>{value}</{name}>" for name, value in values.items())
        (folder / f"{i:05d}.ora.xml").write_text(f"<?xml version='1.0'?><ora>{inner}</ora>")
        pixels = np.round((np.exp(-integrals) - intercept) / slope).astype("<u2")
        pitch_v, pitch_u = g.pixel_size_mm
        rows, columns = integrals.shape
        (folder / f"{i:05d}.mhd").write_text(
            f"ObjectType = Image\nNDims = 3\nDimSize = {columns} {rows} 1\nElementSpacing = {pitch_u} {pitch_v} 1\n"
            f"Offset = {-(columns - 1) / 2 * pitch_u} {-(rows - 1) / 2 * pitch_v} 0\nBinaryData = True\n"
            f"ElementByteOrderMSB = False\nElementType = MET_USHORT\nElementDataFile = {i:05d}.raw\n"
        )
        (folder / f"{i:05d}.raw").write_bytes(pixels.tobytes())
    return folder


# RTK takes Elekta's panel for 409.6 mm, and .hnd to have a multiple of four columns
GEOMETRIES = {
    "elekta": ConeGeometry(1000.0, 1536.0, (72, 92), (409.6 / 80, 409.6 / 100), (-3.0, 2.0)),
    "obi": ConeGeometry(500.0, 800.0, (10, 16), (3.0, 2.5), (4.0, -6.0)),
}
GEOMETRIES["obi-below"] = GEOMETRIES["obi"]
MAKERS: dict[str, tuple[Callable[[Path, Any], Path], str]] = {
    "elekta": (write_elekta, "_Frames.xml"),
    "obi": (partial(write_obi, suffix="hnd"), "ProjectionInfo.xml"),
    "obi-16-bits": (partial(write_obi, suffix="hnc", fan="FullFan"), "ProjectionInfo.xml"),
    "obi-below": (partial(write_obi, suffix="hnd", below="Scan0"), "ProjectionInfo.xml"),
    "obi-16-bits-below": (partial(write_obi, suffix="hnc", below="1.2.840"), "ProjectionInfo.xml"),
    "probeam": (write_probeam, "Scan.xml"),
    "ora": (write_ora, "00000.ora.xml"),
}


@pytest.fixture
def make_files(tmp_path, make_truth) -> Callable[[str], tuple[Path, Any]]:
    """The factory of a maker's folder and the truth that it describes."""

    def make(maker: str) -> tuple[Path, Any]:
        truth = make_truth(geometry=GEOMETRIES[maker]) if maker in GEOMETRIES else make_truth()
        return MAKERS[maker][0](tmp_path / maker, truth), truth

    return make


@pytest.mark.parametrize("maker", MAKERS)
def test_projections_of_a_maker_with_their_geometry(maker, make_files, assert_same) -> None:
    path, truth = make_files(maker)
    assert recognise(path) == recognise(path / MAKERS[maker][1]) == "rtk-projections"
    scan = import_scan(path)
    assert scan.frames == truth.scan.frames
    assert_same(scan, truth, grid=False, pixels=1e-3 if maker == "elekta" else 1e-4)  # whole counts


def test_times_of_frames_are_named_and_a_rate_and_an_exposure_make_a_fly_scan_on_a_circle(make_files, caplog) -> None:
    path, _ = make_files("elekta")
    text = (path / "_Frames.xml").read_text()
    (path / "_Frames.xml").write_text(text.replace("<Seq>1</Seq>", "<Seq>1</Seq><DeltaMs>182</DeltaMs>"))
    import_scan(path)
    said = "no exposure and frames' times (DeltaMs): taken at rest; say frame_time_s or fps if the gantry did not stop"
    assert said in caplog.text
    scan = import_scan(path, ImportOptions(exposure_s=0.4, fps=0.8))
    assert isinstance(scan.trajectory, CircularOrbit) and scan.is_fly and scan.shutter.exposure_s == 0.4


@pytest.mark.parametrize("suffix", AIR)
def test_the_counts_of_air_replace_those_that_rtk_takes(suffix, make_files, caplog) -> None:
    path, truth = make_files({"his": "elekta", "hnd": "obi", "hnc": "obi-16-bits", "xim": "probeam"}[suffix])
    brighter = import_scan(path, ImportOptions(flat_value=2.0 * AIR[suffix]))
    np.testing.assert_allclose(brighter.projections - truth.scan.projections, np.log(2), atol=1e-3)
    if suffix == "hnc":  # which states none
        assert "air" not in caplog.text
        import_scan(path)
        assert "air is taken for 65535 counts, as RTK does; say flat_value" in caplog.text


@pytest.mark.parametrize("maker", ["obi", "obi-16-bits", "probeam"])
def test_pixels_without_counts_are_masked(maker, make_files, monkeypatch) -> None:
    """RTK's own line integral of them is 0, as of air."""

    def spoilt(integrals: np.ndarray, air: float, whole: Callable[..., np.ndarray] = counts) -> np.ndarray:
        image = whole(integrals, air)
        image[2, 5] = 0
        return image

    monkeypatch.setitem(globals(), "counts", spoilt)
    scan = import_scan(make_files(maker)[0])
    assert np.argwhere(np.atleast_3d(scan.pixel_mask)[..., 0] != 0).tolist() in ([[2, 5]], [[7, 5]])


@pytest.mark.parametrize(("dose", "words"), [
    ([800, 900, 1000, 1100, 1200, 1000], "divided by KVNormChamber, 0.8 to 1.2 of its median"),
    ([7, 7, 7, 7, 7, 7], ""), ([0, 0, 0, 0, 0, 0], ""),
    ([800, 900, 1000, 0, 1200, 1000], "a KVNormChamber above 0, as frame 3, are not divided by it (1 of 6)"),
    ([0, -1, 1100, 800, 1000, 1200], "a KVNormChamber above 0, as frame 0, are not divided by it (2 of 6)"),
])  # fmt: skip
def test_the_dose_of_a_truebeam_s_frames(tmp_path, make_truth, caplog, dose, words) -> None:
    truth = make_truth()
    path, usual = write_probeam(tmp_path / "a", truth), np.median([one for one in dose if one > 0] or [1])
    times = np.where(np.array(dose) > 0, dose / usual, 1)
    for file, one in zip(sorted(path.glob("*/*/*.xim")), dose, strict=True):
        name, data = b"KVNormChamber", file.read_bytes()
        count = data.rindex(struct.pack("<I11s", 11, b"KVSourceRtn")) - 4
        more = struct.pack("<I13sIi", len(name), name, 0, one)
        file.write_bytes(data[:count] + struct.pack("<I", 6) + data[count + 4 :] + more)
    scan, light = import_scan(path), np.log(times)[:, None, None]
    np.testing.assert_allclose(scan.projections - light, truth.scan.projections, atol=1e-4)
    assert words in caplog.text and (words or "KVNormChamber" not in caplog.text)


def test_what_rtk_does_not_read_or_is_no_scan_is_one_error_of_one_line(make_files) -> None:
    """Nor are options of no meaning taken, nor two acquisitions of a TrueBeam."""
    path, _ = make_files("ora")
    for options in (ImportOptions(flat_value=5e4), ImportOptions(quantity="counts")):
        with pytest.raises(InputError, match="with format rtk-projections"):
            import_scan(path, options)
    path, _ = make_files("probeam")
    (path / "Acquisitions/2").mkdir()
    (path / "Acquisitions/2/Proj_00000.xim").write_bytes(b"VMS.XI")
    with pytest.raises(InputError, match="found projections of several acquisitions"):
        import_scan(path)
    path, _ = make_files("elekta")
    (path / "00003.his").write_bytes(b"none")
    with pytest.raises(InputError, match="elekta: found files that RTK does not read") as caught:
        import_scan(path)
    assert "\n" not in str(caught.value)
    (path / "00003.his").unlink()
    with pytest.raises(InputError, match="found 5 frames, 6 projections in _Frames.xml"):
        import_scan(path)
    for file in path.glob("*.his"):
        file.unlink()
    with pytest.raises(InputError, match="found no description with projections"):
        import_scan(path, form="rtk-projections")
