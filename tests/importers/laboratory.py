"""Scans written as laboratory scanners write them, by their formats' descriptions; nothing of the importers is used here."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

WHITE = 60000.0


def counts16(truth: Any, white: float = WHITE) -> np.ndarray:
    """Projections (F, v, u) as 16-bit counts, row 0 the lowest."""
    return np.round(white * np.exp(-truth.scan.projections.astype(np.float64))).astype(np.uint16)


def line_integrals_of(counts: np.ndarray, white: float = WHITE) -> np.ndarray:
    """What such counts say of the object, float32."""
    return (-np.log(counts.astype(np.float64) / white)).astype(np.float32)


def steps_deg(truth: Any) -> tuple[float, float]:
    """The first angle and the step of equidistant angles, in degrees, rounded as a scanner's description has them."""
    angle_deg = np.rad2deg(truth.angle_rad)
    return round(float(angle_deg[0]), 9), round(float(angle_deg[1] - angle_deg[0]), 9)


def lab_pixels(
    points: np.ndarray, gantry_rad: float, geometry: Any, axis_mm: float = 0.0, roll_rad: float = 0.0, tilt_rad: float = 0.0
) -> np.ndarray:
    """Pixels (n, 2) (row from below, column from the left) where points (n, 3) of a sample on a stage fall, in the room.
    The room has its origin in the source: x to the right seen from there, y to the panel, z up. The stage turns the sample
    clockwise seen from above, about an axis ``axis_mm`` to the right. The top of the axis leans to the right by ``roll_rad``
    and towards the panel by ``tilt_rad``. At angle 0 the sample's x points to the source, its y to the right."""
    cos, sin = np.cos(gantry_rad), np.sin(gantry_rad)
    x, y, z = points.T
    turned = np.stack([cos * x + sin * y, -sin * x + cos * y, z])  # clockwise
    room = np.stack([turned[1], -turned[0], turned[2]])
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    room = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ room
    c, s = np.cos(tilt_rad), np.sin(tilt_rad)
    room = np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) @ room
    room += np.array([[axis_mm], [geometry.source_to_axis_mm], [0.0]])
    on_panel = geometry.source_to_detector_mm * room[[2, 0]] / room[1]  # v, u
    offset, pitch = (np.array(pair)[:, None] for pair in (geometry.detector_offset_mm, geometry.pixel_size_mm))
    return ((on_panel - offset) / pitch + ((np.array(geometry.detector_shape)[:, None] - 1) / 2)).T


def write_nikon(folder: Path, truth: Any, **lines: object) -> Path:
    """Inspect-X's scan.xtekct with its TIFFs: rows from the top, the right column, seen from the source, first."""
    folder.mkdir()
    g, (first_deg, step_deg) = truth.scan.geometry, steps_deg(truth)
    values: dict[str, object] = {
        "Name": "scan", "InputSeparator": "_", "InputFolderName": "",
        "SrcToObject": g.source_to_axis_mm, "SrcToDetector": g.source_to_detector_mm,
        "DetectorPixelsX": g.detector_shape[1], "DetectorPixelSizeX": g.pixel_size_mm[1], "DetectorOffsetX": 0,
        "DetectorPixelsY": g.detector_shape[0], "DetectorPixelSizeY": g.pixel_size_mm[0], "DetectorOffsetY": 0,
        "Projections": truth.scan.frames, "InitialAngle": first_deg, "AngularStep": step_deg,
        "WhiteLevel": WHITE, "ObjectOffsetX": 0, "ObjectRoll": 0, "ObjectTilt": 0, **lines,
    }  # fmt: skip
    text = "".join(f"{name}={value}\r\n" for name, value in values.items() if value is not None)
    (folder / "scan.xtekct").write_text(f"[XTekCT]\r\n{text}[Xrays]\r\nXraykV=160\r\n")
    for i, image in enumerate(counts16(truth), start=1):
        tifffile.imwrite(folder / f"scan_{i:04d}.tif", image[::-1, ::-1])
    return folder


def write_skyscan(folder: Path, truth: Any, **lines: object) -> Path:
    """A SkyScan's scan_.log with TIFFs and a preview: rows from the top, right column first, lines counted from below."""
    folder.mkdir()
    g, (first_deg, step_deg) = truth.scan.geometry, steps_deg(truth)
    values: dict[str, object] = {
        "Filename Prefix": "scan_", "Number Of Files": f" {truth.scan.frames}", "Number Of Rows": f" {g.detector_shape[0]}",
        "Number Of Columns": g.detector_shape[1], "Camera binning": "1x1", "Image Rotation": "0.0000",
        "Optical Axis (line)": g.detector_shape[0] / 2 - g.detector_offset_mm[0] / g.pixel_size_mm[0],
        "Camera to Source (mm)": g.source_to_detector_mm, "Object to Source (mm)": g.source_to_axis_mm,
        "Image Pixel Size (um)": g.pixel_size_mm[1] / g.magnification * 1000, "Depth (bits)": 16,
        "Reference Intensity": int(WHITE), "Exposure (ms)": 200, "Frame Averaging": "ON (2)",
        "Scanning Start Angle": first_deg, "Rotation Step (deg)": step_deg, "Rotation Direction": "CW",
        "Flat Field Correction": "ON", "Type of Detector Motion": "STEP AND SHOOT", "Scanning Trajectory": "ROUND", **lines,
    }  # fmt: skip
    text = "".join(f"{name}={value}\r\n" for name, value in values.items() if value is not None)
    ratio = g.pixel_size_mm[1] / g.pixel_size_mm[0]
    system = f"[System]\r\nScanner=SkyScan1272\r\nCamera X/Y Ratio={ratio}\r\n"
    (folder / "scan_.log").write_text(f"{system}[Acquisition]\r\n{text}[Reconstruction]\r\nFilename Prefix=rec\r\n")
    for i, image in enumerate(counts16(truth)):
        tifffile.imwrite(folder / f"scan_{i:08d}.tif", image[::-1, ::-1])
    tifffile.imwrite(folder / "scan__spr.tif", image[:3])
    return folder


def write_flexray(folder: Path, truth: Any, **lines: object) -> Path:
    """A FleX-ray's "scan settings.txt" with frames, two flats and a dark: rows from the top, the left column first."""
    folder.mkdir()
    g, angle_deg = truth.scan.geometry, np.rad2deg(truth.angle_rad).round(9)
    values: dict[str, object] = {
        "Sample name": "mine", "Voxel size": f"{g.pixel_size_mm[1] / g.magnification * 1000} um",
        "SOD": g.source_to_axis_mm, "SDD": g.source_to_detector_mm, "ver_tube": "0.0; tube", "tra_tube": "0.0; tube",
        "ver_det": f"{g.detector_offset_mm[0]}; panel", "tra_det": f"{g.detector_offset_mm[1]}; panel", "tra_obj": "0.0;",
        "ROI (LTRB)": "0,0,1943,1535", "# projections": truth.scan.frames, "Binned pixel size": g.pixel_size_mm[0],
        "Start angle": angle_deg[0], "Last angle": angle_deg[-1], **lines,
    }  # fmt: skip
    text = "".join(f"{name} : {value}\n" for name, value in values.items() if value is not None)
    (folder / "scan settings.txt").write_text(f"[Scan settings]\n{text}")
    flats, darks = np.full((2, *g.detector_shape), WHITE), np.zeros((1, *g.detector_shape))
    for name, stack in (("scan_", counts16(truth)), ("io", flats), ("di", darks)):
        for i, image in enumerate(stack):
            tifffile.imwrite(folder / f"{name}{i:06d}.tif", np.asarray(image, np.uint16)[::-1])
    return folder


SECTOR, MINI, CUTOFF = 512, 64, 4096
FREE, END, FAT = 0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD


def write_ole(path: Path, streams: dict[str, bytes]) -> None:
    """An OLE2 container by [MS-CFB]: version 3, small streams in the mini stream, siblings as a chain to the right."""
    sectors: list[bytes] = []
    fat: list[int] = []

    def put(data: bytes) -> int:
        """The first sector of a chain with the data; END for none."""
        count, first = -(-len(data) // SECTOR), len(sectors)
        sectors.extend(data[i * SECTOR : (i + 1) * SECTOR].ljust(SECTOR, b"\0") for i in range(count))
        fat.extend([*range(first + 1, first + count), END][:count])
        return first if count else END

    mini, mini_fat = b"", []
    entries = [["Root Entry", 5, FREE, FREE, END, 0]]  # name, kind, right sibling, child, first sector, size
    storages: dict[str, int] = {}
    last_child: dict[int, int] = {}

    def add(parent: int, entry: list[Any]) -> int:
        entries.append(entry)
        if parent in last_child:
            entries[last_child[parent]][2] = len(entries) - 1
        else:
            entries[parent][3] = len(entries) - 1
        last_child[parent] = len(entries) - 1
        return len(entries) - 1

    # siblings are in the order of [MS-CFB]: shorter names first, then by their letters
    for full in sorted(streams, key=lambda name: [(len(part), part.upper()) for part in name.split("/")]):
        folder, data = full.split("/")[0], streams[full]
        if folder not in storages:
            storages[folder] = add(0, [folder, 1, FREE, FREE, 0, 0])
        if len(data) >= CUTOFF:
            first = put(data)
        else:
            count = -(-len(data) // MINI)
            first = len(mini_fat) if count else END
            mini_fat += [*range(first + 1, first + count), END][:count]
            mini += data.ljust(count * MINI, b"\0")
        add(storages[folder], [full.split("/")[1], 2, FREE, FREE, first, len(data)])
    entries[0][4:] = [put(mini), len(mini)]
    first_mini = put(struct.pack(f"<{len(mini_fat)}I", *mini_fat).ljust(-(-len(mini_fat) // 128) * SECTOR, b"\xff"))
    directory = b""
    for name, kind, right, child, first, size in entries:
        text = (name + "\0").encode("utf-16-le")
        directory += struct.pack("<64sHBBIII", text, len(text), kind, 1, FREE, right, child)
        directory += bytes(16 + 4 + 16) + struct.pack("<IQ", first, size)
    first_directory = put(directory.ljust(-(-len(directory) // SECTOR) * SECTOR, b"\0"))
    own = next(n for n in range(1, 109) if n * 128 >= len(sectors) + n)  # sectors of the FAT, which lists itself
    places = range(len(sectors), len(sectors) + own)
    fat += [FAT] * own + [FREE] * (own * 128 - len(sectors) - own)
    header = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(16) + struct.pack("<HHHHH6x", 0x3E, 3, 0xFFFE, 9, 6)
    header += struct.pack("<IIIIIIIII", 0, own, first_directory, 0, CUTOFF, first_mini, -(-len(mini_fat) // 128), END, 0)
    header += struct.pack("<109I", *places, *[FREE] * (109 - own))
    path.write_bytes(header + b"".join(sectors) + struct.pack(f"<{len(fat)}I", *fat))


def zeiss_streams(truth: Any, **streams: Any) -> dict[str, Any]:
    """The streams of a .txrm as arrays, with room for one image more, as Zeiss leaves it."""
    g, angle_deg = truth.scan.geometry, np.rad2deg(truth.angle_rad).round(9)
    count = truth.scan.frames
    info = {
        "NoOfImages": np.int32(count), "ImageWidth": np.int32(g.detector_shape[1]),
        "ImageHeight": np.int32(g.detector_shape[0]), "DataType": np.int32(5), "XrayGeometry": np.int32(1),
        "PixelSize": np.float32(g.pixel_size_mm[1] / g.magnification * 1000),
        "Angles": np.float32([*-angle_deg, 0]), "StoRADistance": np.float32([-g.source_to_axis_mm] * count + [0]),
        "DtoRADistance": np.float32([g.source_to_detector_mm - g.source_to_axis_mm] * count + [0]),
    }  # fmt: skip
    images = {f"ImageData{i // 100 + 1}/Image{i + 1}": image for i, image in enumerate(counts16(truth))}
    return {
        **{f"ImageInfo/{name}": value for name, value in info.items()}, **images,
        "Alignment/X-Shifts": np.zeros(count, np.float32), "Alignment/Y-Shifts": np.zeros(count, np.float32),
        "ReferenceData/Image": np.full(g.detector_shape, WHITE, np.float32), **streams,
    }  # fmt: skip


def write_zeiss(path: Path, truth: Any, **streams: Any) -> Path:
    """A .txrm: row 0 the lowest, angles of a sample that turns counterclockwise; a stream of None is left out."""
    path = path.with_suffix(".txrm")
    write_ole(path, {k: v.tobytes() for k, v in zeiss_streams(truth, **streams).items() if v is not None})
    return path
