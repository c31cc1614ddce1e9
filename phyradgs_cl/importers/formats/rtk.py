"""Scans of RTK: a geometry file (RTKThreeDCircularGeometry, version 3) and a stack of projections as MetaImage.

The geometry has nine numbers per projection. RTK's writer leaves out numbers that are 0 everywhere. A
SourceToDetectorDistance of 0 is a parallel beam, in which RTK ignores source distance and source offsets. The parser opens
no file that the XML names."""

import logging
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, PoseTable, Scan
from phyradgs_cl.acquisition.geometry import Geometry, towards_source
from phyradgs_cl.acquisition.plausible import question_unit
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import assemble
from phyradgs_cl.importers.assemble import along
from phyradgs_cl.importers.files import SafeFolder, read_bytes
from phyradgs_cl.importers.frames import line_integrals
from phyradgs_cl.importers.images import STACKS, read_image
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.text import Settings

_log = logging.getLogger(__name__)
ROOT = "RTKThreeDCircularGeometry"
NAMES = (
    *("SourceToIsocenterDistance", "SourceToDetectorDistance", "GantryAngle"),
    *("SourceOffsetX", "SourceOffsetY", "ProjectionOffsetX", "ProjectionOffsetY"),
    *("InPlaneAngle", "OutOfPlaneAngle"),
)
_TO_AXIS, _TO_DETECTOR, _ANGLE = NAMES[:3]
_ANGLES = ("GantryAngle", "InPlaneAngle", "OutOfPlaneAngle")
_RADIUS = "RadiusCylindricalDetector"
_RAW, _ORA = (".his", ".hnd", ".hnc", ".xim"), ".ora.xml"  # endings of files that rtk_projections.py reads
XIM_BELOW, HND_BELOW = "Acquisitions/*/*.xim", "*/*.hn[cd]"
"""Patterns of the paths of Varian's projections, relative to the folder of Scan.xml and of ProjectionInfo.xml."""
# RTK's X, Y, Z are our y, z, x: the same right-handed frame with other names of its axes.
_TO_WORLD = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Stack:
    """Projections (F, v, u), and their pixels on the panel: the first one and the steps along u and v, each (x, y) in mm."""

    frames: np.ndarray
    origin_mm: np.ndarray
    step_u_mm: np.ndarray
    step_v_mm: np.ndarray


def recognises(path: Path) -> bool:
    """Returns whether ``path`` is a folder with an .xml file and a MetaImage, or one of the two files. An .ora.xml file, and
    an .xml file in a folder of raw projections, are left to rtk_projections.py."""
    folder = SafeFolder(path if path.is_dir() else path.parent)
    is_stack = path.suffix.lower() in STACKS
    descriptions = folder.matching(".xml") if path.is_dir() or is_stack else [path] if path.suffix.lower() == ".xml" else []
    if all(file.name.lower().endswith(_ORA) for file in descriptions):
        return False
    if path.is_dir() or is_stack:
        return bool(folder.matching(*STACKS))
    return not folder.matching(*_RAW) and not any(any(folder.root.glob(p)) for p in (XIM_BELOW, HND_BELOW))


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a folder with one .xml and one .mha (or .mhd). ``path`` may also be one of the two files in it."""
    folder = SafeFolder(path if path.is_dir() else path.parent)
    is_stack = path.suffix.lower() in STACKS and path.is_file()
    description = path if path.is_file() and not is_stack else folder.only("geometry", ".xml")
    stack_path = path if is_stack else folder.only("stack of projections", *STACKS)
    rtk, image = read_rtk_xml(description), read_image(stack_path)
    sitk = checks.package("SimpleITK", "the package that reads this file", "phyradgs-cl[formats]")
    places_mm, direction = (image.GetOrigin(), image.GetSpacing()), np.reshape(image.GetDirection(), (3, 3))
    stack = stack_of(sitk.GetArrayFromImage(image), *places_mm, direction, f"{stack_path} TransformMatrix")
    return scan_of(rtk, stack, options, (str(description), str(stack_path)), description.stem, path)


def scan_of(
    rtk: "RtkGeometry", stack: Stack, options: ImportOptions, subjects: tuple[str, str], title: str, path: Path,
    clock: str = "",
) -> Scan:
    """Returns the scan of a geometry and its projections. subjects: what messages call the geometry and the projections.
    clock: see ``StoredTiming``. Raises InputError if their numbers of frames differ."""
    described, stored = subjects
    if len(stack.frames) != rtk.frames:
        found = f"{len(stack.frames)} frames, {rtk.frames} projections in {Path(described).name}"
        raise InputError(stored, found, "one frame per projection")
    timing = assemble.make_timing(described, rtk.frames, options, assemble.StoredTiming(clock=clock))
    trajectory, geometry, turn = _trajectory(rtk, stack, timing, described)
    convention = "attenuation" if stack.frames.dtype.kind == "f" and options.flat_value is None else None
    integrals = line_integrals(stored, turn.frames(stack.frames), options, convention=convention)
    return assemble.assemble_scan(integrals, trajectory, geometry, timing, options, path, title=title)


def stack_of(
    frames: np.ndarray, origin_mm: tuple[float, ...], spacing_mm: tuple[float, ...], direction: np.ndarray, subject: str
) -> Stack:
    """Returns a stack of projections (F, v, u), from ITK's origin and spacing (3,) in mm and its direction (3, 3). Raises
    InputError unless the third axis, which counts frames, is perpendicular to the others."""
    steps_mm = direction * spacing_mm  # its columns are the steps along u, along v and to the next frame
    if np.abs([*steps_mm[:2, 2], *steps_mm[2, :2]]).max() > 1e-9 * np.abs(steps_mm).max():
        raise InputError(subject, str(steps_mm.tolist())[:80], "axes of a stack: columns, rows, frames")
    return Stack(frames, np.array(origin_mm[:2]), steps_mm[:2, 0], steps_mm[:2, 1])


def _trajectory(
    rtk: "RtkGeometry", stack: Stack, timing: assemble.Timing, subject: str
) -> tuple[CircularOrbit | PoseTable, Geometry, assemble.Turned]:
    """Returns the trajectory, the nearest circular geometry, and the images' flips. The trajectory is a circular orbit
    where the file's poses lie on one, else a pose table."""
    panel = (stack.frames.shape[1], stack.frames.shape[2])

    def stored(position: np.ndarray) -> np.ndarray:
        return rtk.poses(position, stack.origin_mm, stack.step_u_mm, stack.step_v_mm)

    first = stored(np.zeros(1))[0]
    turn = assemble.turn_of(np.concatenate([towards_source(first, rtk.is_parallel), first[3:]]))

    def poses(position: np.ndarray) -> np.ndarray:
        return turn.poses(stored(position), panel)

    question_unit(rtk.values[_ANGLE], f"{subject} {_ANGLE}", "deg")
    table, geometry = assemble.table_over_time(poses, timing, subject, panel, rtk.is_parallel)
    if rtk.is_circular and stack.step_u_mm[1] == stack.step_v_mm[0] == 0:
        return assemble.turning(geometry, rtk.values[_ANGLE], timing), geometry, turn
    return table, geometry, turn


@dataclass(frozen=True, eq=False)
class RtkGeometry:
    """The geometry's numbers (F,), one per projection, by RTK's names: lengths in mm, angles in rad."""

    values: dict[str, np.ndarray]

    @property
    def frames(self) -> int:
        return len(self.values[_ANGLE])

    @property
    def is_parallel(self) -> bool:
        return not self.values[_TO_DETECTOR].any()

    @property
    def is_circular(self) -> bool:
        """Whether source and panel turn about the axis at constant distances and offsets, without tilts; in a cone beam also
        without offsets of the source."""
        of_source = (_TO_AXIS, "SourceOffsetX", "SourceOffsetY") if self.is_parallel else ()
        steady = [v for name, v in self.values.items() if name not in (_ANGLE, *of_source)]
        still = all(np.ptp(v) <= 1e-9 * (1 + np.abs(v).max()) for v in steady)
        tilts = {"SourceOffsetX", "SourceOffsetY", "InPlaneAngle", "OutOfPlaneAngle"} - set(of_source)
        return still and all(np.all(self.values[name] == 0) for name in tilts)

    def poses(
        self, position: np.ndarray, origin_mm: np.ndarray, step_u: np.ndarray, step_v: np.ndarray
    ) -> np.ndarray:
        """Returns poses (T, 12), see ``PoseTable``, at frame positions (T,), interpolated or extrapolated linearly.
        origin_mm (2,): where pixel (0, 0) lies on the panel. step_u, step_v (2,): steps in mm to the next column and row."""
        at = {name: along(np.unwrap(v) if name in _ANGLES else v, position) for name, v in self.values.items()}
        # rotates from the gantry's to RTK's fixed frame: the inverse of Rz(−in plane) Rx(−out of plane) Ry(−gantry)
        angles_rad = np.stack([at[name] for name in ("GantryAngle", "OutOfPlaneAngle", "InPlaneAngle")], -1)
        turn = Rotation.from_euler("YXZ", angles_rad).as_matrix()
        zero = np.zeros(position.shape)
        offsets = [at["SourceOffsetX"], at["SourceOffsetY"], at[_TO_AXIS]]
        to_detector = at[_TO_AXIS] - at[_TO_DETECTOR]
        if self.is_parallel:  # the first three numbers of a pose are then the rays' direction; the panel is on the axis
            offsets, to_detector = [zero, zero, zero - 1], zero
        shift = np.stack([at["ProjectionOffsetX"], at["ProjectionOffsetY"], to_detector], -1)
        first = shift + np.array([*origin_mm, 0.0])
        steps = [np.broadcast_to([*step, 0.0], first.shape) for step in (step_u, step_v)]
        parts = (np.stack(offsets, -1), first, *steps)
        return np.concatenate([np.einsum("tij,tj->ti", turn, part) @ _TO_WORLD.T for part in parts], -1)


def read_rtk_xml(path: Path) -> RtkGeometry:
    """Reads a geometry file of RTK. Without SourceToDetectorDistance the beam is parallel, with a warning. Raises InputError
    for numbers that are missing or impossible."""
    root = _root(path)
    common, projections = _numbers(path, root), [_numbers(path, e) for e in root.iterfind("Projection")]
    if not projections:
        raise InputError(str(path), "no Projection", "at least one")
    stored = {name: [one.get(name, common.get(name)) for one in projections] for name in NAMES}
    is_parallel = not any(stored[_TO_DETECTOR])
    for name in (_ANGLE,) if is_parallel else (_ANGLE, _TO_AXIS, _TO_DETECTOR):
        if None in stored[name]:
            where = f"no {name} for projection {stored[name].index(None)}"
            raise InputError(str(path), where, "one, in the projection or above all of them")
    columns = {name: np.array([0.0 if value is None else value for value in column]) for name, column in stored.items()}
    columns |= {name: np.deg2rad(columns[name]) for name in _ANGLES}
    if is_parallel and None in stored[_TO_DETECTOR]:
        _log.warning("%s: no %s, which RTK takes for 0: a parallel beam", path, _TO_DETECTOR)
    for name in () if is_parallel else (_TO_AXIS, _TO_DETECTOR):
        if columns[name].min() <= 0:
            expected = "a length above 0" + (", or 0 in all projections" if name == _TO_DETECTOR else "")
            raise InputError(f"{path} {name}", f"{columns[name].min():g}", expected)
    if not is_parallel and np.any(columns[_TO_DETECTOR] <= columns[_TO_AXIS]):
        raise InputError(f"{path} {_TO_DETECTOR}", f"{columns[_TO_DETECTOR].min():g}", f"more than {_TO_AXIS}")
    return RtkGeometry(columns)


def _root(path: Path) -> ElementTree.Element:
    try:
        root = ElementTree.fromstring(read_bytes(path))
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # LookupError: an unknown encoding
        raise InputError(str(path), f"XML that is not well formed ({error})", f"a {ROOT}") from error
    if root.tag != ROOT or root.get("version", "3") != "3":
        found = f"a root element {root.tag[:60]!r}, version {root.get('version', '3')[:20]}"
        raise InputError(str(path), found, f"{ROOT}, version 3")
    return root


def _numbers(path: Path, parent: ElementTree.Element) -> dict[str, float]:
    """Returns the numbers directly below an XML element, by name. Raises InputError about ``path`` for a curved panel."""
    texts = Settings(f"{path}:", {e.tag: e.text or "" for e in parent})
    if radius := texts.position(_RADIUS):
        raise texts.error(_RADIUS, f"{radius:g}", "a flat panel")
    return {name: texts.position(name) for name in NAMES if texts.has(name)}
