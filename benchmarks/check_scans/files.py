"""Writes scans in the documented formats: NXtomo by h5py, or TIFF folders and RTK stacks for `phyradgs import`."""

import shutil
import subprocess
from pathlib import Path

import h5py
import itk
import numpy as np
import tifffile
from itk import RTK as rtk
from objects import SIDE_MM, SIZE, VOXEL_MM
from recording import Recorded, Setup, geometry, stack_origin

PROJECTION, FLAT, DARK = 0, 1, 2


def write_nxtomo(
    path: Path,
    title: str,
    setup: Setup,
    recorded: Recorded | np.ndarray,
    angle_unit: str = "deg",
    angle_factor: float = 1.0,
    with_grid: bool = True,
) -> None:
    """Writes a scan file (docs/formats.md) that states ``setup``.

    An array in place of counts is written as line integrals. Angles are multiplied by ``angle_factor`` and written in
    ``angle_unit``."""
    frames, keys, mask = _stored(recorded)
    starts = np.arange(len(frames)) * setup.frame_time_s
    is_projection = keys == PROJECTION
    angle = np.where(is_projection, setup.angle_deg(starts), setup.angle_deg(starts[is_projection][-1]))
    sign = 1.0 if setup.rotates == "gantry" else -1.0
    swept = setup.step_deg * setup.exposure_s / setup.frame_time_s
    with h5py.File(path, "w") as file:
        file.attrs.update(NX_class="NXroot", default="entry")
        entry = _group(file, "entry", "NXentry", definition="NXtomo", title=title)
        instrument = _group(entry, "instrument", "NXinstrument")
        _group(instrument, "source", "NXsource", distance=(-setup.source_mm, "mm"))
        detector = _group(
            instrument,
            "detector",
            "NXdetector",
            image_key=keys,
            x_pixel_size=(setup.pitch_u_mm, "mm"),
            y_pixel_size=(setup.pitch_v_mm, "mm"),
            distance=(setup.detector_mm - setup.source_mm, "mm"),
            count_time=(setup.exposure_s, "s"),
            frame_start_time=(starts, "s"),
        )
        stored = detector.create_dataset("data", data=frames, compression="gzip", compression_opts=1)
        stored.attrs["quantity"] = "counts" if isinstance(recorded, Recorded) else "attenuation"
        if mask is not None:
            detector["pixel_mask"] = mask.astype(np.uint8)
        sample = _group(entry, "sample", "NXsample", rotation_angle=(angle_factor * sign * angle, angle_unit))
        own = _group(
            entry,
            "phyradgs",
            "NXcollection",
            detector_offset=((setup.offset_v_mm, setup.offset_u_mm), "mm"),
            detector_model=setup.model,
        )
        names = ["rotation_angle"]
        if setup.moving:
            end = angle_factor * sign * (angle + swept * is_projection)
            _fill(sample, rotation_angle_end=(end, angle_unit))
            names.append("rotation_angle_end")
            _fill(detector, detector_readout_time=(setup.readout_s, "s"))
            if setup.readout_s > 0:
                _fill(own, readout_axis=setup.axis, readout_direction=setup.direction)
        for name in names:
            sample[name].attrs["rotates"] = setup.rotates
        if setup.roll_deg:
            times = np.arange(0.0, starts[is_projection][-1] + setup.span_s + 0.1, 0.1)
            poses = setup.pose(setup.angle_deg(times))
            _group(own, "poses", "NXcollection", time_s=(times, "s"), pose=(poses, "mm"))
        if not with_grid:
            return
        grid = {"shape": (SIZE,) * 3, "voxel_size": ((VOXEL_MM,) * 3, "mm"), "offset": ((0.0,) * 3, "mm")}
        _group(own, "grid", "NXcollection", **grid)


def _stored(recorded: Recorded | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    if not isinstance(recorded, Recorded):
        return recorded.astype(np.float32), np.zeros(len(recorded), np.int32), None
    parts = [recorded.frames, recorded.flats, recorded.darks]
    keys = np.repeat([PROJECTION, FLAT, DARK], [len(part) for part in parts]).astype(np.int32)
    values = np.concatenate(parts)
    return values.astype(_counts_type(values)), keys, recorded.mask


def _counts_type(values: np.ndarray) -> type:
    whole = values.max() < 2**16 and bool(np.all(values == np.rint(values)))
    return np.uint16 if whole else np.float32


def _group(parent: h5py.Group, name: str, kind: str, **members: object) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = kind
    _fill(group, **members)
    return group


def _fill(group: h5py.Group, **members: object) -> None:
    """Writes datasets. A pair of a value and a unit makes a dataset with that unit."""
    for name, value in members.items():
        if isinstance(value, tuple) and isinstance(value[-1], str):
            group[name] = np.asarray(value[0], np.float64)
            group[name].attrs["units"] = value[1]
        else:
            group[name] = value


def write_tiffs(folder: Path, title: str, setup: Setup, recorded: Recorded, flat_value: float | None) -> None:
    """Writes one TIFF per frame, row 0 at the top, and a TOML file. ``flat_value`` replaces flats and darks."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    kinds = {"proj": recorded.frames}
    if flat_value is None:
        kinds |= {"flat": recorded.flats, "dark": recorded.darks}
    for kind, frames in kinds.items():
        for number, frame in enumerate(frames):
            values = np.ascontiguousarray(frame[::-1].astype(np.uint16))
            tifffile.imwrite(folder / f"{kind}_{number:04d}.tif", values, compression="zlib")
    lines = [f'title = "{title}"', "[frames]", 'projections = "proj_*.tif"', 'row_0 = "top"']
    if flat_value is None:
        lines += ['flats = "flat_*.tif"', 'darks = "dark_*.tif"']
    else:
        lines += ['quantity = "counts"', f"flat_value = {flat_value}"]
    lines += ["[source]", f"to_axis_mm = {setup.source_mm}", f"to_detector_mm = {setup.detector_mm}"]
    lines += ["[detector]", f"pixel_size_v_mm = {setup.pitch_v_mm}", f"pixel_size_u_mm = {setup.pitch_u_mm}"]
    lines += [f"offset_v_mm = {setup.offset_v_mm}", f"offset_u_mm = {setup.offset_u_mm}"]
    lines += ["[angles]", f"first_deg = {setup.first_deg}", f"step_deg = {setup.step_deg}"]
    if setup.moving:
        lines += ["[timing]", f"exposure_s = {setup.exposure_s}", f"readout_s = {setup.readout_s}"]
        lines += [f"frame_time_s = {setup.frame_time_s}"]
        lines += ["[readout]", f'axis = "{setup.axis}"', f"direction = {setup.direction}"]
    lines += ["[volume]", f"shape = {[SIZE] * 3}", f"size_mm = {[SIDE_MM] * 3}"]
    (folder / "scan.toml").write_text("\n".join(lines) + "\n", "utf-8")


def write_rtk(folder: Path, setup: Setup, integrals: np.ndarray) -> None:
    """Writes an RTK stack of line integrals and its geometry, by ITK and RTK themselves."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    image = itk.image_from_array(np.ascontiguousarray(integrals, np.float32))
    image.SetSpacing((setup.pitch_u_mm, setup.pitch_v_mm, 1.0))
    image.SetOrigin(stack_origin(setup))
    itk.imwrite(image, str(folder / "projections.mha"))
    writer = rtk.ThreeDCircularProjectionGeometryXMLFileWriter.New()
    writer.SetFilename(str(folder / "geometry.xml"))
    circle = geometry(setup, setup.angle_deg(setup.starts_s))  # the writer holds no reference to it
    writer.SetObject(circle)
    writer.WriteFile()


def imported(command: list[str], source: Path, target: Path, extra: list[str]) -> None:
    """Runs `phyradgs import` of a folder."""
    arguments = [*command, "import", str(source), "-o", str(target), *extra]
    done = subprocess.run(arguments, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)}: {done.stderr.strip()}")
