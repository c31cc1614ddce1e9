"""Scans of RTK: a geometry XML and a stack of projections as MetaImage."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, PoseTable, Scan
from phyradgs_cl.acquisition.geometry import plain_geometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.formats.moving_poses import Turned, table_over_time, turn_of
from phyradgs_cl.importers.formats.rtk_xml import RtkGeometry, read_rtk_xml
from phyradgs_cl.importers.options import TIMING, ImportOptions
from phyradgs_cl.importers.reading.folder import SafeFolder
from phyradgs_cl.importers.reading.frames import line_integrals
from phyradgs_cl.importers.reading.images import STACKS, read_image
from phyradgs_cl.importers.scan_parts import put_together
from phyradgs_cl.importers.timing import Timing, make_timing, turning

OPTIONS = (*TIMING, "quantity", "flat_value", "detector_model")


@dataclass(frozen=True, eq=False)
class _Stack:
    """Projections (F, v, u); origin and steps along u and v, each (2,): (x, y) in the image's plane in mm."""

    frames: np.ndarray
    origin_mm: np.ndarray
    step_u_mm: np.ndarray
    step_v_mm: np.ndarray


def import_rtk(path: Path, options: ImportOptions) -> Scan:
    """A folder with one .xml and one .mha (or .mhd), or the .xml itself with the stack beside it."""
    options.refuse_unused("rtk", OPTIONS)
    folder = SafeFolder(path if path.is_dir() else path.parent)
    description = path if path.is_file() else folder.only("geometry", ".xml")
    stack_path = folder.only("stack of projections", *STACKS)
    rtk, stack = read_rtk_xml(description), _read_stack(stack_path)
    if len(stack.frames) != rtk.frames:
        found = f"{len(stack.frames)} frames, {rtk.frames} projections in {description.name}"
        raise InputError(str(stack_path), found, "one frame per projection")
    timing = make_timing(str(description), rtk.frames, options)
    trajectory, geometry, turn = _trajectory(rtk, stack, timing, str(description))
    custom = "attenuation" if stack.frames.dtype.kind == "f" and options.flat_value is None else None
    integrals = line_integrals(str(stack_path), turn.frames(stack.frames), options, custom=custom)
    title = description.stem
    return put_together(integrals, trajectory, geometry, timing, options, title=title, source=str(path))


def _read_stack(path: Path) -> _Stack:
    """Reads a MetaImage of projections. InputError unless its third axis, the frames, is perpendicular to the others."""
    image = read_image(path)
    steps_mm = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()  # columns: along u, v and the frames
    if np.abs([*steps_mm[:2, 2], *steps_mm[2, :2]]).max() > 1e-9 * np.abs(steps_mm).max():
        found = str(steps_mm.tolist())[:80]
        raise InputError(f"{path} TransformMatrix", found, "axes of a stack: columns, rows, frames")
    frames = checks.package("SimpleITK", "the package that reads this file", "phyradgs-cl[formats]").GetArrayFromImage(image)
    return _Stack(frames, np.array(image.GetOrigin()[:2]), steps_mm[:2, 0], steps_mm[:2, 1])


def _trajectory(
    rtk: RtkGeometry, stack: _Stack, timing: Timing, subject: str
) -> tuple[CircularOrbit | PoseTable, ConeGeometry, Turned]:
    """A circular orbit where one describes the file, else a table of poses; and how images have to be turned."""
    panel = (stack.frames.shape[1], stack.frames.shape[2])

    def stored(position: np.ndarray) -> np.ndarray:
        return rtk.poses(position, stack.origin_mm, stack.step_u_mm, stack.step_v_mm)

    turn = turn_of(stored(np.zeros(1))[0])

    def poses(position: np.ndarray) -> np.ndarray:
        return turn.poses(stored(position), panel)

    at_frames = poses(np.arange(rtk.frames, dtype=np.float64))
    geometry = plain_geometry(at_frames, panel)
    if rtk.is_circular and stack.step_u_mm[1] == stack.step_v_mm[0] == 0:
        return turning(geometry, rtk.values["GantryAngle"], timing), geometry, turn
    return table_over_time(poses, timing, subject), geometry, turn
