"""Scans of RTK: a geometry XML and a stack of projections as MetaImage."""

from pathlib import Path

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, PoseTable, Scan
from phyradgs_cl.acquisition.geometry import plain_geometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.formats.moving_poses import Turned, table_over_time, turn_of
from phyradgs_cl.importers.formats.rtk_xml import RtkGeometry, read_rtk_xml
from phyradgs_cl.importers.options import TIMING, ImportOptions
from phyradgs_cl.importers.reading.folder import SafeFolder
from phyradgs_cl.importers.reading.frames import line_integrals
from phyradgs_cl.importers.reading.meta_image import SUFFIXES, read_meta_stack
from phyradgs_cl.importers.reading.voxels import Voxels
from phyradgs_cl.importers.scan_parts import put_together
from phyradgs_cl.importers.timing import Timing, make_timing, turning

OPTIONS = (*TIMING, "quantity", "flat_value", "detector_model")


def import_rtk(path: Path, options: ImportOptions) -> Scan:
    """A folder with one .xml and one .mha (or .mhd), or the .xml itself with the stack beside it."""
    options.refuse_unused("rtk", OPTIONS)
    folder = SafeFolder(path if path.is_dir() else path.parent)
    description = path if path.is_file() else folder.only("geometry", ".xml")
    stack_path = folder.only("stack of projections", *SUFFIXES)
    rtk, stack = read_rtk_xml(description), read_meta_stack(stack_path)
    if len(stack.values) != rtk.frames:
        found = f"{len(stack.values)} frames, {rtk.frames} projections in {description.name}"
        raise InputError(str(stack_path), found, "one frame per projection")
    timing = make_timing(str(description), rtk.frames, options)
    trajectory, geometry, turn = _trajectory(rtk, stack, timing, str(description))
    custom = "attenuation" if stack.values.dtype.kind == "f" and options.flat_value is None else None
    integrals = line_integrals(str(stack_path), turn.frames(stack.values), options, custom=custom)
    title = description.stem
    return put_together(integrals, trajectory, geometry, timing, options, title=title, source=str(path))


def _trajectory(
    rtk: RtkGeometry, stack: Voxels, timing: Timing, subject: str
) -> tuple[CircularOrbit | PoseTable, ConeGeometry, Turned]:
    """A circular orbit where one describes the file, else a table of poses; and how images have to be turned."""
    panel = (stack.values.shape[1], stack.values.shape[2])
    assert stack.steps_mm is not None and stack.origin_mm is not None  # every MetaImage has them
    place = stack.origin_mm[:2], stack.steps_mm[0, :2], stack.steps_mm[1, :2]

    def stored(position: np.ndarray) -> np.ndarray:
        return rtk.poses(position, *place)

    turn = turn_of(stored(np.zeros(1))[0])

    def poses(position: np.ndarray) -> np.ndarray:
        return turn.poses(stored(position), panel)

    at_frames = poses(np.arange(rtk.frames, dtype=np.float64))
    geometry = plain_geometry(at_frames, panel)
    if rtk.is_circular and stack.steps_mm[0, 1] == stack.steps_mm[1, 0] == 0:
        return turning(geometry, rtk.values["GantryAngle"], timing), geometry, turn
    return table_over_time(poses, timing, subject), geometry, turn
