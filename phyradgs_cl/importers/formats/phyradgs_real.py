"""Real scans of PhyRadGS: a JSON of calibrated views with the arcs of their rolling shutter, and 16-bit TIFF frames.

A view's ``detector`` is a 4×4 matrix from the panel to the world (mm). Column 0 points to the image's next column, column 1
to its next row, and column 3 is the panel's centre. During an exposure the panel leaves this centre and is rotated about
+z with the gantry. The first stored row is read first."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import PoseTable, Scan, Shutter
from phyradgs_cl.acquisition.geometry import plain_geometry
from phyradgs_cl.acquisition.plausible import question_unit
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import tiff
from phyradgs_cl.importers.assemble import Timing, assemble_scan, turn_of
from phyradgs_cl.importers.files import SafeFolder, read_json
from phyradgs_cl.importers.formats import r2_gaussian as synthetic
from phyradgs_cl.importers.frames import line_integrals
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.series import series_of
from phyradgs_cl.io.tables import Fields

_log = logging.getLogger(__name__)
PROJECTIONS = "projections"
_ANGLES = ("first_row_start_angle", "first_row_end_angle", "last_row_end_angle")
_TIMES_A_FRAME = 33  # poses per frame in the pose table, from its first line's opening to its last line's closing
_GAP = 1e-3  # least pause between two frames, as a fraction of a frame's duration: times in a pose table must rise


@dataclass(frozen=True, eq=False)
class Circle:
    """The circle on which the source or the panel moves: centre (x, y) and radius in mm. For each view: height z (F,) in
    mm, and angles (F, 3) in rad at which its first line opens and closes and its last line closes."""

    centre: np.ndarray
    radius: float
    z: np.ndarray
    angle_rad: np.ndarray

    @classmethod
    def read(cls, common: Fields, views: list[Fields], body: str) -> "Circle":
        circle = common.table(body)
        tables = [view.table("rolling_shutter").table(body) for view in views]
        angles = np.deg2rad([[table.number(key) for key in _ANGLES] for table in tables])
        centre = circle.numbers("center")
        if len(centre) < 2:
            raise circle.error("center", f"{len(centre)} numbers", "x, y and perhaps z")
        z = np.array([table.number("z") for table in tables])
        return cls(centre[:2], circle.length("radius"), z, angles)

    def at(self, view: int, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns a view's angles (T,) in rad and points (T, 3) on the circle in mm. share (T,): times after the opening of
        the view's first line, divided by the exposure time."""
        start, closed, _ = self.angle_rad[view]
        angle = start + (closed - start) * share
        x, y = (self.centre[:, None] + self.radius * np.stack([np.cos(angle), np.sin(angle)])).tolist()
        return angle, np.stack([x, y, np.full(angle.shape, self.z[view])], -1)


def recognises(path: Path) -> bool:
    """Returns whether ``path`` is a .json file other than the descriptions of ``r2_gaussian``, or a folder. The folder must
    hold a .json file, none of these descriptions, and TIFF frames or a folder ``projections``."""
    others = (synthetic.META, synthetic.META_WITH_TIMES)
    if not path.is_dir():
        return path.suffix.lower() == ".json" and path.name not in others
    folder = SafeFolder(path)
    if any(folder.exists(name) for name in others) or not folder.matching(".json"):
        return False
    return folder.exists(PROJECTIONS) or bool(folder.matching(*tiff.SUFFIXES))


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports a folder with one JSON. The TIFF frames lie in it or its folder ``projections``. ``path`` may be the JSON."""
    checks.one_of(options.called("readout_axis"), options.readout_axis or "rows", ("rows",))
    description = path if path.is_file() else SafeFolder(path).only("description of the views", ".json")
    meta = Fields(f"{description}:", read_json(description))
    frames, views = _frames_and_views(description, list(meta.tables("views")), options)
    panel = (frames.shape[1], frames.shape[2])
    common = meta.table("rolling_shutter_geometry")
    source, detector = (Circle.read(common, views, body) for body in ("source", "detector"))
    question_unit(detector.angle_rad[:, 0], f"{description} angles", "deg")
    shutter, start_s = _timing(str(description), detector, options)
    if (pitch := options.pixel_size_mm) is None:
        expected, remedy = "a length in mm along v and along u", f"say {options.named('pixel_size_mm')}"
        raise InputError(f"{description} pixel size", "nothing", expected, remedy)
    share = np.linspace(0, shutter.span_s / shutter.exposure_s, _TIMES_A_FRAME)
    poses = np.stack([  # (F, T, 12): poses of the images as stored, at T times of each frame
        _view_poses(view, source.at(i, share)[1], detector.at(i, share), detector.centre, panel, pitch)
        for i, view in enumerate(views)
    ])  # fmt: skip
    turn = turn_of(poses[0, 0])
    shutter = replace(shutter, direction=options.readout_direction or (-1 if turn.rows else 1))
    timing = Timing(shutter, start_s, True, assumed=() if options.exposure_s is not None else ("exposure",))
    poses = turn.poses(poses, panel)
    times = start_s[:, None] + np.linspace(0, shutter.span_s, _TIMES_A_FRAME)
    integrals = line_integrals(
        str(description), turn.frames(frames), _with_flat(str(description), options, frames), convention="counts"
    )
    trajectory = PoseTable(times.ravel(), poses.reshape(-1, 12), f"{description} views")
    plain = plain_geometry(poses[:, 0], panel)
    return assemble_scan(integrals, trajectory, plain, timing, options, path, title=path.resolve().stem)


def _frames_and_views(
    description: Path, views: list[Fields], options: ImportOptions
) -> tuple[np.ndarray, list[Fields]]:
    """Reads frames (F, v, u) as stored, and returns them with their views: all views of the JSON, or with the option
    ``first_view`` the F views from this one on. Raises InputError unless there is one frame per view."""
    below = description.parent / PROJECTIONS
    folder = SafeFolder(below if below.exists() else description.parent)
    paths = folder.matching(*tiff.SUFFIXES)
    if options.first_view is not None:
        paths = series_of(paths, str(folder.root), "complete the frames").paths  # frame i has view first_view + i
        views = views[options.first_view : options.first_view + len(paths)]
    if not paths or len(paths) != len(views):
        found = f"{len(paths)} TIFF files for {len(views)} views"
        remedy = f"say {options.named('first_view')} if the JSON holds several scans"
        raise InputError(str(folder.root), found, "one frame per view", remedy)
    frames = tiff.read_tiffs(paths)
    if len(frames) != len(views):
        raise InputError(str(folder.root), f"{len(frames)} pages for {len(views)} views", "one page per file")
    return frames, views


def _with_flat(subject: str, options: ImportOptions, frames: np.ndarray) -> ImportOptions:
    """Returns the options, completed by a flat value if the frames are counts without one: the brightest pixel, as in
    PhyRadGS's published code, with a warning. Raises InputError for frames without a count above 0."""
    if options.flat_value is not None or options.quantity not in (None, "counts"):
        return options
    brightest = float(frames.max())
    if not brightest > 0:
        raise InputError("frames", "nothing but zeros", "counts")
    text = "%s: counts without flats: the brightest pixel, %g counts, is taken as air; else say %s"
    _log.warning(text, subject, brightest, options.named("flat_value"))
    return replace(options, flat_value=brightest)


def _timing(subject: str, detector: Circle, options: ImportOptions) -> tuple[Shutter, np.ndarray]:
    """Returns shutter and opening times (F,) in s. Delays frames that would overlap: a pose table has one pose at a time."""
    marks_rad = np.unwrap(detector.angle_rad, axis=1)
    marks_rad += (np.unwrap(marks_rad[:, 0]) - marks_rad[:, 0])[:, None]
    exposure_s, readout_s, start_s = synthetic.blurred_timing_s(subject, marks_rad, options)
    shutter = Shutter(exposure_s, readout_s)
    least_s = shutter.span_s * (1 + _GAP)
    return shutter, np.concatenate([[0.0], np.cumsum(np.maximum(np.diff(start_s), least_s))])


def _view_poses(
    view: Fields, source_mm: np.ndarray, detector: tuple[np.ndarray, np.ndarray], centre: np.ndarray,
    panel: tuple[int, int], pitch: tuple[float, float],
) -> np.ndarray:
    """Returns a view's poses (T, 12), see ``PoseTable``. detector: the panel's angles (T,) in rad and centres (T, 3) in mm.
    The panel is rotated about +z by its angle minus the angle at which its matrix holds. centre (2,): of its circle."""
    rotation, stands_at = _matrix(view)
    angle_rad, centre_mm = detector
    turned_rad = angle_rad - np.arctan2(stands_at[1] - centre[1], stands_at[0] - centre[0])
    cos, sin, zero = np.cos(turned_rad), np.sin(turned_rad), np.zeros_like(turned_rad)
    turn = np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1], -1).reshape(-1, 3, 3)
    step_v, step_u = pitch[0] * turn @ rotation[:, 1], pitch[1] * turn @ rotation[:, 0]
    first = centre_mm - (panel[1] - 1) / 2 * step_u - (panel[0] - 1) / 2 * step_v
    return np.concatenate([source_mm, first, step_u, step_v], -1)


def _matrix(view: Fields) -> tuple[np.ndarray, np.ndarray]:
    rows = view.get("detector")
    if not isinstance(rows, list) or len(rows) != 4:
        raise view.error("detector", "no 4×4 matrix", "four rows of four numbers")
    matrix = np.array([Fields(view.name("detector"), {"row": row}).numbers("row", 4) for row in rows])
    rotation = matrix[:3, :3]
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-3):
        raise view.error("detector", "columns that are not orthonormal", "a rotation and a centre")
    return rotation, matrix[:3, 3]
