"""Scans written as TIGRE and LEAP describe theirs; nothing of the importers is used here."""

import pickle
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np


def is_cone(truth: Any) -> bool:
    return hasattr(truth.scan.geometry, "source_to_axis_mm")


def leap_values(truth: Any) -> dict[str, object]:
    """The parameters of LEAP's save_parameters: φ is a quarter turn ahead of the source's angle."""
    g, grid = truth.scan.geometry, truth.scan.grid
    sides = zip(g.detector_shape, g.detector_offset_mm, g.pixel_size_mm, strict=True)
    centre = [(count - 1) / 2 - offset / pitch for count, offset, pitch in sides]
    distances = {"sod": g.source_to_axis_mm, "sdd": g.source_to_detector_mm} if is_cone(truth) else {"sod": 0, "sdd": 0}
    return {
        **{f"num{axis}": n for axis, n in zip("ZYX", grid.shape, strict=True)},
        "voxelWidth": grid.voxel_size_mm[1], "voxelHeight": grid.voxel_size_mm[0],
        **{f"offset{axis}": mm for axis, mm in zip("ZYX", grid.offset_mm, strict=True)},
        "geometry": "cone" if is_cone(truth) else "parallel", "numAngles": truth.scan.frames,
        "numRows": g.detector_shape[0], "numCols": g.detector_shape[1], "pixelHeight": g.pixel_size_mm[0],
        "pixelWidth": g.pixel_size_mm[1], "centerRow": centre[0], "centerCol": centre[1],
        "phis": ", ".join(map(repr, (np.rad2deg(truth.angle_rad).round(9) + 90).tolist())), **distances,
        "tau": 0.0, "tiltAngle": 0.0, "helicalPitch": 0.0,
    }  # fmt: skip


def write_leap(folder: Path, truth: Any, **values: object) -> Path:
    """LEAP's parameters with the line integrals as an array."""
    folder.mkdir()
    text = [f"{name} = {value}\n" for name, value in {**leap_values(truth), **values}.items() if value is not None]
    (folder / "params.txt").write_text("# CT geometry parameters\n" + "".join(text))
    np.save(folder / "g.npy", truth.scan.projections)
    return folder


def tigre_geometry(truth: Any, **attributes: object) -> Any:
    """An object of a class by the name of TIGRE's, which is not installed."""
    names = ("tigre", "tigre.utilities", "tigre.utilities.geometry")
    for name in names:
        sys.modules.setdefault(name, types.ModuleType(name))
    module = sys.modules[names[-1]]
    if not hasattr(module, "Geometry"):
        module.Geometry = type("Geometry", (), {"__module__": names[-1]})
    geo, g, grid = module.Geometry(), truth.scan.geometry, truth.scan.grid
    values = {
        "mode": "cone" if is_cone(truth) else "parallel", "accuracy": 0.5, "filter": None,
        **({"DSO": g.source_to_axis_mm, "DSD": g.source_to_detector_mm} if is_cone(truth) else {}),
        "nDetector": np.array(g.detector_shape), "dDetector": np.array(g.pixel_size_mm),
        "offDetector": np.array(g.detector_offset_mm), "rotDetector": np.zeros(3), "nVoxel": np.array(grid.shape),
        "dVoxel": np.array(grid.voxel_size_mm), "offOrigin": np.array(grid.offset_mm), "COR": 0, **attributes,
    }  # fmt: skip
    for name, value in values.items():
        setattr(geo, name, value)
    return geo


def write_tigre(path: Path, truth: Any, **attributes: object) -> Path:
    """A pickle of what TIGRE's loaders return."""
    content = (truth.scan.projections, tigre_geometry(truth, **attributes), truth.angle_rad)
    path.write_bytes(pickle.dumps(content))
    return path
