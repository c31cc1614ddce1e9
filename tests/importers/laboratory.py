"""Scans written as laboratory scanners write them, by their formats' descriptions; nothing of the importers is used here."""

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
    points: np.ndarray, gantry_rad: float, geometry: Any, axis_mm: float = 0.0, roll_rad: float = 0.0,
    tilt_rad: float = 0.0,
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
    middle = (np.array(geometry.detector_shape)[:, None] - 1) / 2
    return ((on_panel - offset) / pitch + middle).T


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
