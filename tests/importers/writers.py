"""Foreign files written as their own programs write them, from a Truth; nothing of the importers is used here."""

import json
import pickle
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import laboratory_of_importers as lab
import numpy as np
import SimpleITK as sitk
import tifffile

AIR, DARK = 50000.0, 300.0


def is_cone(truth: Any) -> bool:
    return hasattr(truth.scan.geometry, "source_to_axis_mm")


def scanner_table(truth: Any, unit_mm: float) -> dict[str, object]:
    """meta_data.json's scanner; lengths in scene units."""
    g, grid = truth.scan.geometry, truth.scan.grid
    lengths_mm = {
        "sDetector": np.multiply(g.detector_shape, g.pixel_size_mm), "sVoxel": grid.size_mm[::-1],
        "offOrigin": grid.offset_mm[::-1], "offDetector": g.detector_offset_mm[::-1],
    }  # fmt: skip
    # R2-Gaussian writes distances of parallel scenes too, which TIGRE does not use
    to_axis, to_detector = (g.source_to_axis_mm, g.source_to_detector_mm) if is_cone(truth) else (1.0, 1.0)
    return {
        "mode": "cone" if is_cone(truth) else "parallel", "accuracy": 0.5, "DSD": to_detector / unit_mm,
        "DSO": to_axis / unit_mm,
        "nDetector": list(g.detector_shape), "nVoxel": list(grid.shape[::-1]),
        **{name: [float(one) / unit_mm for one in three] for name, three in lengths_mm.items()},
    }  # fmt: skip


def write_r2(folder: Path, truth: Any, unit_mm: float = 1.0, test: int = 2) -> Path:
    """An R2-Gaussian folder: the last ``test`` frames are held out."""
    folder.mkdir()
    meta: dict[str, Any] = {"scanner": scanner_table(truth, unit_mm), "vol": "vol_gt.npy", "bbox": [[-1] * 3, [1] * 3]}
    np.save(folder / "vol_gt.npy", np.transpose(truth.scan.reference, (2, 1, 0)) * unit_mm)
    count = truth.scan.frames - test
    for part, frames in (("train", range(count)), ("test", range(count, truth.scan.frames))):
        (folder / f"proj_{part}").mkdir()
        meta[f"proj_{part}"] = []
        for i in frames:
            name = f"proj_{part}/{i:04d}.npy"
            np.save(folder / name, truth.scan.projections[i][::-1])
            meta[f"proj_{part}"].append({"file_path": name, "angle": float(truth.angle_rad[i])})
    (folder / "meta_data.json").write_text(json.dumps(meta))
    return folder


def write_phyradgs(folder: Path, truth: Any) -> Path:
    """A synthetic PhyRadGS folder: the same, with where first and last lines began and ended."""
    write_r2(folder, truth, test=0)
    shutter, sweeps = truth.scan.shutter, truth.scan.trajectory.kinematics
    arc, meta = sweeps.angle_end_rad - sweeps.angle_start_rad, json.loads((folder / "meta_data.json").read_text())
    meta["simulate_train"] = [
        {
            **entry, "first_line_start": entry["angle"], "first_line_end": entry["angle"] + a,
            "last_line_end": entry["angle"] + a * (1 + shutter.readout_s / shutter.exposure_s),
        }
        for entry, a in zip(meta["proj_train"], arc, strict=True)
    ]
    meta["simulate_test"] = meta["simulate_train"][:1]
    (folder / "meta_data_motion_blur_rolling_shutter_fps18.json").write_text(json.dumps(meta))
    return folder


def naf_dict(truth: Any, dtype: type = np.float32) -> dict[str, object]:
    """A NAF dictionary: mm, densities per metre, the last two frames for validation."""
    g, grid, frames = truth.scan.geometry, truth.scan.grid, truth.scan.projections[:, ::-1].astype(dtype)
    count = len(frames) - 2
    return {
        "numTrain": count, "numVal": 2,
        **({"DSD": g.source_to_detector_mm, "DSO": g.source_to_axis_mm} if is_cone(truth) else {"mode": "parallel"}),
        "nDetector": list(g.detector_shape), "dDetector": list(g.pixel_size_mm),
        "nVoxel": list(grid.shape[::-1]), "dVoxel": list(grid.voxel_size_mm[::-1]),
        "offOrigin": list(grid.offset_mm[::-1]), "offDetector": list(g.detector_offset_mm[::-1]),
        "image": np.transpose(truth.scan.reference, (2, 1, 0)) * 1e3,
        "train": {"angles": truth.angle_rad[:count], "projections": frames[:count]},
        "val": {"angles": truth.angle_rad[count:], "projections": frames[count:]},
    }


def write_naf(path: Path, truth: Any, protocol: int = 4, dtype: type = np.float32, numbers: bool = False) -> Path:
    """``numbers``: NumPy's own scalars and small arrays, lists of them, and arrays in Fortran order."""
    content: dict[str, Any] = naf_dict(truth, dtype)
    if numbers:
        content = {key: one if isinstance(one, dict) else np.asarray(one)[()] for key, one in content.items()}
        for part in (content["train"], content["val"]):
            part["angles"], part["projections"] = list(part["angles"]), np.asfortranarray(part["projections"])
    path.write_bytes(pickle.dumps(content, protocol))
    return path


def write_phyradgs_real(folder: Path, truth: Any, centre_mm: tuple[float, float] = (0.0, 0.0)) -> Path:
    """Views with 4×4 detector matrices (image x, image y downwards, away from the source) and 16-bit counts. The circles may
    be centred off the axis; matrices are given where the panel stands in the middle of the exposure."""
    scan, g = truth.scan, truth.scan.geometry
    sweeps, ratio = scan.trajectory.kinematics, scan.shutter.readout_s / scan.shutter.exposure_s
    (folder / "projections").mkdir(parents=True)
    centre = np.array([*centre_mm, 0.0])
    off_v, off_u = g.detector_offset_mm
    assert off_u == 0, "source and panel face each other in this writer"
    views = []
    for i in range(scan.frames):
        a, b = sweeps.angle_start_rad[i], sweeps.angle_end_rad[i]
        marks = np.rad2deg([a, b, a + ratio * (b - a), b + ratio * (b - a)])
        names = ("first_row_start_angle", "first_row_end_angle", "last_row_start_angle", "last_row_end_angle")
        radial = np.array([np.cos((a + b) / 2), np.sin((a + b) / 2), 0])
        x, y = np.array([-radial[1], radial[0], 0]), np.array([0, 0, -1.0])
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = x, y, np.cross(x, y)
        matrix[:3, 3] = centre - (g.source_to_detector_mm - g.source_to_axis_mm) * radial + [0, 0, off_v]
        views.append({
            "source": (centre + g.source_to_axis_mm * radial).tolist(),
            "detector": matrix.tolist(),
            "rolling_shutter": {
                "source": {"z": 0.0, **dict(zip(names, marks.tolist(), strict=True))},
                "detector": {"z": off_v, **dict(zip(names, (marks + 180).tolist(), strict=True))},
            },
        })  # fmt: skip
        counts = np.round(AIR * np.exp(-scan.projections[i].astype(np.float64)))[::-1].astype(np.uint16)
        tifffile.imwrite(folder / "projections" / f"{i}.tif", counts)
    behind = g.source_to_detector_mm - g.source_to_axis_mm
    circles = {
        "detector": {"center": [*centre_mm, off_v], "radius": behind},
        "source": {"center": [*centre_mm, 0.0], "radius": g.source_to_axis_mm},
    }
    (folder / "geometric_motion_rs.json").write_text(json.dumps({"views": views, "rolling_shutter_geometry": circles}))
    return folder


def write_rtk(
    folder: Path, truth: Any, flip: bool = False, compressed: bool = False, name: str = "projections.mha"
) -> Path:
    """RTK's XML with its constants at the top, of a parallel beam without distances, and a stack by SimpleITK; ``flip``
    stores rows from the top."""
    folder.mkdir()
    g = truth.scan.geometry
    (nv, nu), (dv, du), (off_v, off_u) = g.detector_shape, g.pixel_size_mm, g.detector_offset_mm
    frame = "  <Projection>\n    <GantryAngle>{:.15g}</GantryAngle>\n  </Projection>\n"
    angles = "".join(map(frame.format, np.rad2deg(truth.angle_rad)))
    distances = "" if truth.scan.is_parallel else (
        f"  <SourceToIsocenterDistance>{g.source_to_axis_mm}</SourceToIsocenterDistance>\n"
        f"  <SourceToDetectorDistance>{g.source_to_detector_mm}</SourceToDetectorDistance>\n"
    )
    # a part of the offset in the geometry, the rest in the stack's own origin
    (folder / "geometry.xml").write_text(
        '<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n<RTKThreeDCircularGeometry version="3">\n'
        f"{distances}  <ProjectionOffsetX>{off_u}</ProjectionOffsetX>\n{angles}</RTKThreeDCircularGeometry>\n"
    )
    frames = truth.scan.projections
    stack = sitk.GetImageFromArray(np.ascontiguousarray(frames[:, ::-1] if flip else frames))
    stack.SetSpacing((du, dv, 1.0))
    low, high = off_v - (nv - 1) / 2 * dv, off_v + (nv - 1) / 2 * dv
    stack.SetOrigin((-(nu - 1) / 2 * du, high if flip else low, 0.0))
    if flip:
        stack.SetDirection((1, 0, 0, 0, -1, 0, 0, 0, 1))
    sitk.WriteImage(stack, str(folder / name), useCompression=compressed)
    return folder


def counts(truth: Any, dead: tuple[int, int] | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Projections, flats and darks in counts, float32; the flat field is uneven, ``dead`` (row, column) sees nothing."""
    shape = truth.scan.geometry.detector_shape
    ramp = AIR * (1 + 0.1 * np.linspace(-1, 1, shape[0])[:, None] + 0.05 * np.linspace(-1, 1, shape[1]))
    dark = DARK + np.arange(shape[1])
    frames = dark + (ramp - dark) * np.exp(-truth.scan.projections.astype(np.float64))
    flats, darks = np.stack([ramp, ramp]), np.broadcast_to(dark, (3, *shape)).copy()
    if dead is not None:
        frames[:, dead[0], dead[1]] = flats[:, dead[0], dead[1]] = DARK
        darks[:, dead[0], dead[1]] = DARK
    return frames, flats, darks


def write_data_exchange(path: Path, truth: Any, dead: tuple[int, int] | None = None) -> Path:
    """/exchange as beamlines write it: rows from the top, angles of the sample in degrees."""
    frames, flats, darks = counts(truth, dead)
    with h5py.File(path, "w") as file:
        file["implements"] = "exchange:measurement"
        for name, stack in (("data", frames), ("data_white", flats), ("data_dark", darks)):
            file[f"exchange/{name}"] = stack[:, ::-1]
        file["exchange/theta"] = -np.rad2deg(truth.angle_rad)
        file["exchange/theta"].attrs["units"] = "deg"
        detector = file.create_group("measurement/instrument/detector")
        for axis, pitch in zip("yx", truth.scan.geometry.pixel_size_mm, strict=True):
            detector[f"pixel_size_{axis}"] = pitch * 1e3
            detector[f"pixel_size_{axis}"].attrs["units"] = "um"
    return path


def write_nxtomo(path: Path, truth: Any, flips: tuple[bool, bool] = (False, False)) -> Path:
    """By the nxtomo package: flats and darks among the frames, no timing; flips (up-down, left-right) declared."""
    import pint  # quick tests, which import this module, do without both packages
    from nxtomo.application import nxtomo

    units, g = pint.get_application_registry(), truth.scan.geometry
    frames, flats, darks = counts(truth)
    stack = np.concatenate([darks[:1], flats[:1], frames, flats[1:]])
    stack, tomo = stack[:, :: -1 if flips[0] else 1, :: -1 if flips[1] else 1], nxtomo.NXtomo()
    tomo.title = "theirs"
    detector = tomo.instrument.detector
    detector.data = np.ascontiguousarray(stack.astype(np.float32))
    detector.image_key_control = [2, 1, *[0] * len(frames), 1]
    detector.y_pixel_size, detector.x_pixel_size = (pitch * units.mm for pitch in g.pixel_size_mm)
    behind_mm = g.source_to_detector_mm - g.source_to_axis_mm if is_cone(truth) else 12.0  # the way to the panel
    detector.distance = behind_mm / 1000 * units.m
    detector.count_time = np.full(len(stack), 0.4) * units.s
    column = -g.detector_offset_mm[1] / g.pixel_size_mm[1]
    detector.x_rotation_axis_pixel_position = -column if flips[1] else column
    detector.set_transformation_from_ud_flipped(flips[0])
    detector.set_transformation_from_lr_flipped(flips[1])
    if is_cone(truth):
        tomo.instrument.source.distance = -g.source_to_axis_mm / 1000 * units.m
    angle_deg = -np.rad2deg(truth.angle_rad)
    tomo.sample.rotation_angle = np.concatenate([[0, 0], angle_deg, [angle_deg[-1]]]) * units.degree
    tomo.save(str(path), "entry0000")
    return path


def write_pages(path: Path, stack: np.ndarray, way: str) -> None:
    """A stack (n, v, u) as one file, in one of the ways in which programs do it."""
    if way == "SimpleITK":
        sitk.WriteImage(sitk.GetImageFromArray(stack), str(path))
        return
    options: dict[str, dict[str, Any]] = {
        "plain": {}, "imagej": {"imagej": True},
        "planar": {"photometric": "minisblack", "planarconfig": "separate"},
        "volumetric": {"photometric": "minisblack", "volumetric": True},
        "tiled": {"photometric": "minisblack", "volumetric": True, "tile": (16, 16, 16)},
        "big-endian": {"photometric": "minisblack", "byteorder": ">"},
        "deflated": {"photometric": "minisblack", "compression": "zlib", "rowsperstrip": 3},
    }
    tifffile.imwrite(path, stack, **options[way])


def write_tiff(folder: Path, truth: Any, timing: str = "", angles: str | None = None, **dead: tuple[int, int]) -> Path:
    """A folder of float TIFFs, flats and darks by tifffile, and scan.toml."""
    folder.mkdir()
    frames, flats, darks = counts(truth, **dead)
    for name, stack in (("proj", frames), ("flat", flats), ("dark", darks)):
        for i, image in enumerate(stack):
            tifffile.imwrite(folder / f"{name}_{i}.tif", image[::-1].astype(np.float64))
    g, grid = truth.scan.geometry, truth.scan.grid
    distances = f"to_axis_mm = {g.source_to_axis_mm}\nto_detector_mm = {g.source_to_detector_mm}" if is_cone(truth) else ""
    angles = angles or f"values_deg = {np.rad2deg(truth.angle_rad).tolist()}"
    (folder / "scan.toml").write_text(
        f"""title = "tiff"
[frames]
projections = "proj_*.tif"
flats = "flat_*.tif"
darks = "dark_*.tif"
[source]
{distances or 'beam = "parallel"'}
[detector]
pixel_size_v_mm = {g.pixel_size_mm[0]}
pixel_size_u_mm = {g.pixel_size_mm[1]}
offset_v_mm = {g.detector_offset_mm[0]}
offset_u_mm = {g.detector_offset_mm[1]}
[volume]
shape = {list(grid.shape)}
size_mm = {list(grid.size_mm)}
offset_mm = {list(grid.offset_mm)}
[angles]
{angles}
{timing}
"""
    )
    return folder


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
    for name in ("tigre", "tigre.utilities", "tigre.utilities.geometry"):
        module = sys.modules.setdefault(name, types.ModuleType(name))
    if not hasattr(module, "Geometry"):
        module.Geometry = type("Geometry", (), {"__module__": name})
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


def write_tigre(path: Path, truth: Any, protocol: int = 4, **attributes: object) -> Path:
    """A pickle of what TIGRE's loaders return."""
    content = (truth.scan.projections, tigre_geometry(truth, **attributes), truth.angle_rad)
    path.write_bytes(pickle.dumps(content, protocol))
    return path


# format: (what writes a good one, under which name)
WRITERS = {
    "r2": (write_r2, "r2"), "phyradgs": (write_phyradgs, "phyradgs"),
    "phyradgs-real": (write_phyradgs_real, "real"),
    "naf": (write_naf, "chest.pickle"), "rtk": (write_rtk, "rtk"),
    "data-exchange": (write_data_exchange, "dx.h5"),
    "nxtomo": (write_nxtomo, "nx.h5"), "tiff": (write_tiff, "tiff"),
    "nikon": (lab.write_nikon, "nikon"), "skyscan": (lab.write_skyscan, "skyscan"),
    "flexray": (lab.write_flexray, "flexray"), "zeiss": (lab.write_zeiss, "sample.txrm"),
    "leap": (write_leap, "leap"), "tigre": (write_tigre, "tigre.pickle"),
}  # fmt: skip
# of the panel, where a format cannot state all
OFFSETS_MM = {"phyradgs-real": (4.0, 0.0), "nikon": (0.0, 0.0), "zeiss": (0.0, 0.0), "skyscan": (4.0, 0.0)}


def write(form: str, folder: Path, make_truth: Any) -> Path:
    """A good one in a folder, of a scan that the format can hold; real views have source and panel face each other."""
    is_fly = form.startswith("phyradgs")
    truth = make_truth(fly=is_fly)
    if form in OFFSETS_MM:
        truth = make_truth(fly=is_fly, geometry=replace(truth.scan.geometry, detector_offset_mm=OFFSETS_MM[form]))
    writer, name = WRITERS[form]
    return writer(folder / name, truth)
