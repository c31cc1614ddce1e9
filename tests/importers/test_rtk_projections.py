"""Raw projections of makers, read by the package itk-rtk, where that is installed (conftest.py)."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import ImportOptions, import_scan, recognise

RIM = 4  # pixels that RTK cuts off each side of Elekta's images
PANEL_MM = 409.6
GEOMETRY = ConeGeometry(1000.0, 1536.0, (72, 92), (PANEL_MM / 80, PANEL_MM / 100), (-3.0, 2.0))


def write_elekta(folder: Path, truth: Any) -> Path:
    """_Frames.xml with the panel's places, and .HIS images: 100 bytes of header, 65536 less the counts in 16 bits."""
    folder.mkdir()
    off_v, off_u = truth.scan.geometry.detector_offset_mm
    frames = []
    for i, (angle_rad, integrals) in enumerate(zip(truth.angle_rad, truth.scan.projections, strict=True), start=1):
        angle_deg = round(np.rad2deg(angle_rad), 9)
        place = f"<GantryAngle>{angle_deg}</GantryAngle><UCentre>{-off_u}</UCentre><VCentre>{-off_v}</VCentre>"
        frames.append(f"<Frame><Seq>{i}</Seq>{place}</Frame>")
        rows, columns = (count + 2 * RIM for count in integrals.shape)
        header = bytearray(68)
        header[:4] = bytes([0, 112, 68, 0])
        struct.pack_into("<HHHHHH", header, 10, 32, 1, 1, rows, columns, 1)
        struct.pack_into("<H", header, 32, 4)
        image = np.zeros((rows, columns), np.uint16)
        image[RIM:-RIM, RIM:-RIM] = np.round(65536 * (1 - np.exp(-integrals.astype(np.float64))))
        (folder / f"{i:05d}.his").write_bytes(bytes(header) + bytes(32) + image.astype("<u2").tobytes())
    text = f"<?xml version='1.0'?><ImageFrames><Frames>{''.join(frames)}</Frames></ImageFrames>"
    (folder / "_Frames.xml").write_text(text)
    return folder


@pytest.fixture
def elekta(tmp_path, make_truth) -> tuple[Path, Any]:
    truth = make_truth(geometry=GEOMETRY)
    return write_elekta(tmp_path / "xvi", truth), truth


def test_elekta_s_projections_with_their_geometry(elekta, assert_same) -> None:
    path, truth = elekta
    assert recognise(path) == recognise(path / "_Frames.xml") == "rtk-projections"
    scan = import_scan(path)
    assert isinstance(scan.trajectory, CircularOrbit)
    assert_same(scan, truth, grid=False, pixels=1e-3)
    fly = import_scan(path, ImportOptions(exposure_s=0.4, fps=0.8))
    assert fly.is_fly and fly.shutter.exposure_s == 0.4


def test_what_rtk_does_not_read_is_one_error_of_one_line(elekta) -> None:
    path, _ = elekta
    (path / "00003.his").write_bytes(b"none")
    with pytest.raises(InputError, match="xvi: found files that RTK does not read") as caught:
        import_scan(path)
    assert "\n" not in str(caught.value)
    (path / "00003.his").unlink()
    with pytest.raises(InputError, match="found 5 frames, 6 projections in _Frames.xml"):
        import_scan(path)


def test_a_description_alone_is_not_taken(elekta) -> None:
    path, _ = elekta
    for file in path.glob("*.his"):
        file.unlink()
    with pytest.raises(InputError, match="found no description with projections"):
        import_scan(path, form="rtk-projections")
