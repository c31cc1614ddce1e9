"""Folders of R2-Gaussian: meta_data.json with .npy projections and the true volume, taken at rest. Axes are as in NAF and
PhyRadGS: projections [v, u] with row 0 at +z, volumes [x, y, z].

Synthetic folders of PhyRadGS also have the gantry's angles at which every frame's first line opens and closes and its last
line closes, but no times. The exposure is the option ``exposure_s``, or 1 s. The gantry's speed is the mean angle that it
turns during an exposure / the exposure time."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, FrameSweeps, Scan, Shutter
from phyradgs_cl.acquisition.geometry import ConeGeometry, Geometry, ParallelGeometry
from phyradgs_cl.acquisition.plausible import question_unit
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.importers.assemble import Timing, assemble_scan, make_timing, turning
from phyradgs_cl.importers.files import SafeFolder, read_json, read_npy
from phyradgs_cl.importers.frames import line_integrals, oriented
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.io.scan import BEAMS
from phyradgs_cl.io.tables import Fields

META = "meta_data.json"
META_WITH_TIMES = "meta_data_motion_blur_rolling_shutter_fps18.json"  # the description's name in folders of PhyRadGS
ROW_0 = "top"
_KEYS = ("first_line_start", "first_line_end", "last_line_end")
_SAME = 1e-3  # the ratio readout time / exposure time may differ between frames by this × max(1, largest ratio)


@dataclass(frozen=True, eq=False)
class R2Folder:
    """A folder of R2-Gaussian, with its description and geometry. unit_mm: the length of the scene's unit in mm."""

    folder: SafeFolder
    meta: Fields
    geometry: Geometry
    unit_mm: float

    @classmethod
    def opened(cls, given: Path, usual: str, unit_mm: float) -> "R2Folder":
        """Reads the description: the file ``given``, or ``usual`` in the folder ``given``. unit_mm: mm per scene unit."""
        folder = SafeFolder(given if given.is_dir() else given.parent)
        name = usual if given.is_dir() else given.name
        path = folder.file(name, str(folder.root / name))
        meta = Fields(f"{path}:", read_json(path))
        return cls(folder, meta, read_geometry(meta.table("scanner"), unit_mm), unit_mm)

    def frame(self, entry: Fields) -> np.ndarray:
        """Reads the projection (v, u) that an entry of the description names, as stored."""
        name = entry.word("file_path")
        first_copy = name.replace("_sim1", "")  # _sim1 marks a repetition; the first simulation is read if it is there
        path = self.folder.file(first_copy if self.folder.exists(first_copy) else name, entry.name("file_path"))
        image = read_npy(path, 2)
        checks.shape(str(path), image, self.geometry.detector_shape)
        return image

    def scan(
        self, path: Path, entries: list[Fields], orbit: CircularOrbit, timing: Timing, options: ImportOptions
    ) -> Scan:
        """Returns a scan of the frames in ``entries`` on ``orbit``, with the true volume in 1/mm if the folder has it."""
        grid, reference = read_grid(self.meta.table("scanner"), self.unit_mm), None
        if self.meta.has("vol"):
            truth = self.folder.file(self.meta.word("vol"), self.meta.name("vol"))
            reference = turned_volume(str(truth), read_npy(truth, 3), grid, 1 / self.unit_mm)
        names = [entry.word("file_path") for entry in entries]
        if twice := [i for i, name in enumerate(names) if name in names[:i]]:
            raise InputError(entries[twice[0]].name("file_path"), f"{names[twice[0]]!r} again", "every frame once")
        frames = oriented(np.stack([self.frame(entry) for entry in entries]), options, ROW_0)
        integrals = line_integrals(str(self.folder.root), frames, options, convention="attenuation")
        parts = integrals, orbit, self.geometry, timing, options, path
        return assemble_scan(*parts, title=path.resolve().name, grid=grid, reference=reference)


def entries_of(meta: Fields, prefix: str, part: str) -> list[Fields]:
    """Returns the description's entries for the frames of ``part``: "train", "test", or "all" for both in this order.
    prefix: precedes train and test in the description's keys."""
    parts = ("train", "test") if part == "all" else (part,)
    return [entry for name in parts for entry in meta.tables(f"{prefix}{name}")]


def recognises(path: Path) -> bool:
    """Returns whether ``path`` is R2-Gaussian's description, or a folder with this description and without PhyRadGS's."""
    if path.is_dir():
        return (path / META).exists() and not (path / META_WITH_TIMES).exists()
    return path.name == META


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports the frames of the option ``part``: by default train, under the description's key ``proj_train``."""
    opened = R2Folder.opened(path, META, options.unit_mm)
    entries = entries_of(opened.meta, "proj_", options.part)
    angle_rad = np.array([entry.number("angle") for entry in entries])
    question_unit(angle_rad, f"{opened.meta.subject} angles", "rad")
    timing = make_timing(str(path), len(entries), options)
    return opened.scan(path, entries, turning(opened.geometry, angle_rad, timing), timing, options)


def read_geometry(scanner: Fields, unit_mm: float) -> Geometry:
    """Reads the beam from a scanner's table, whose lengths are multiples of ``unit_mm``. nDetector and dDetector are [v, u],
    offDetector is [u, v]. The distances of mode "parallel" are not read, as in TIGRE."""
    rows, columns = scanner.counts("nDetector", 2)
    pitch_v, pitch_u = (float(p * unit_mm) for p in _pitches(scanner, "Detector", (rows, columns)))
    offset_u, offset_v = (float(o * unit_mm) for o in _offset(scanner, "offDetector", 2))
    sides = (rows, columns), (pitch_v, pitch_u), (offset_v, offset_u)
    if scanner.word("mode", BEAMS, default="cone") == "parallel":
        return ParallelGeometry(*sides)
    to_axis, to_detector = scanner.length("DSO"), scanner.length("DSD")
    if to_detector <= to_axis:
        raise scanner.error("DSD", f"{to_detector:g}", f"more than DSO ({to_axis:g})")
    return ConeGeometry(to_axis * unit_mm, to_detector * unit_mm, *sides)


def read_grid(scanner: Fields, unit_mm: float) -> Grid:
    """Reads the voxel grid from a scanner's table of triples [x, y, z], whose lengths are multiples of ``unit_mm``."""
    counts = scanner.counts("nVoxel", 3)
    size = _pitches(scanner, "Voxel", counts) * unit_mm
    origin = _offset(scanner, "offOrigin", 3) * unit_mm
    return Grid(triple(counts[::-1]), triple(size[::-1].tolist()), triple(origin[::-1].tolist()))


def _pitches(scanner: Fields, what: str, counts: tuple[int, ...]) -> np.ndarray:
    """Returns a pixel's or voxel's size along each axis, from the key d + ``what``. If this key is missing, divides the
    total sizes, key s + ``what``, by ``counts``. what: "Detector" or "Voxel"."""
    if scanner.has(f"d{what}"):
        return scanner.lengths(f"d{what}", len(counts))
    return scanner.lengths(f"s{what}", len(counts)) / np.array(counts)


def _offset(scanner: Fields, key: str, count: int) -> np.ndarray:
    """Returns the first ``count`` numbers of ``key``; zeros if the key is missing. offDetector may have an unused third
    number. Raises InputError for fewer numbers than ``count``."""
    if not scanner.has(key):
        return np.zeros(count)
    values = scanner.numbers(key)
    if len(values) < count:
        raise scanner.error(key, f"{len(values)} values", f"{count} numbers")
    return values[:count]


def turned_volume(subject: str, volume: np.ndarray, grid: Grid, per_mm: float) -> np.ndarray:
    """Returns a stored volume [x, y, z] as (nz, ny, nx) float32 in 1/mm. per_mm: factor from the stored values to 1/mm.
    Raises InputError about ``subject`` for a shape other than the grid's, and for values that are not finite in float32."""
    checks.shape(subject, volume, grid.shape[::-1])
    checks.finite(subject, volume)
    turned = np.transpose(volume, (2, 1, 0)).astype(np.float64) * per_mm
    if (largest := float(np.abs(turned).max())) > float(np.finfo(np.float32).max):
        raise InputError(subject, f"a density of {largest:.3g} 1/mm", "one that float32 holds", "check the file")
    return np.ascontiguousarray(turned, np.float32)


def recognises_with_times(path: Path) -> bool:
    """Returns whether ``path`` is a folder with the description of PhyRadGS's synthetic scans, or the description itself."""
    return (path / META_WITH_TIMES).exists() if path.is_dir() else path.name == META_WITH_TIMES


def import_scan_with_times(path: Path, options: ImportOptions) -> Scan:
    """Imports the frames of the option ``part``: by default train, under the description's key ``simulate_train``. Columns
    are read out one after the other unless the option ``readout_axis`` says rows."""
    opened = R2Folder.opened(path, META_WITH_TIMES, options.unit_mm)
    entries = entries_of(opened.meta, "simulate_", options.part)
    marks = np.array([[entry.number(key) for key in _KEYS] for entry in entries])
    question_unit(marks[:, 0], f"{opened.meta.subject} angles", "rad")
    exposure_s, readout_s, start_s = blurred_timing_s(opened.meta.subject, marks, options)
    axis = options.readout_axis or "columns"  # unless options say otherwise, column 0 or the top row is read first
    direction = options.readout_direction or (1 if axis == "columns" else -1)
    unstated = {"exposure": options.exposure_s, "axis": options.readout_axis, "first": options.readout_direction}
    assumed = tuple(name for name, value in unstated.items() if value is None)
    timing = Timing(Shutter(exposure_s, readout_s, axis, direction), start_s, True, assumed=assumed)
    sweeps = FrameSweeps(start_s, exposure_s, marks[:, 0], marks[:, 1])
    return opened.scan(path, entries, CircularOrbit(opened.geometry, sweeps), timing, options)


def blurred_timing_s(
    subject: str, marks_rad: np.ndarray, options: ImportOptions
) -> tuple[float, float, np.ndarray]:
    """Returns exposure, readout and opening times (F,), from 0 on, in s. marks_rad (F, 3): the gantry's angles when each
    frame's first line opens, when it closes, and when the last line closes. The exposure is the options', or 1 s, because
    files state none. The gantry's speed is taken as constant: the mean over the exposures. Raises InputError for an exposure
    of 0 s or less, one without a turn or with turns of both signs, and readouts that are not one ratio of it, at least 0."""
    exposure_s = 1.0 if options.exposure_s is None else options.exposure_s
    if exposure_s <= 0:
        raise InputError(options.named("exposure_s"), f"{exposure_s:g}", "a time above 0 s", "the frames are blurred")
    exposure_arc, readout_arc = np.diff(marks_rad, axis=1).T
    if np.any(exposure_arc == 0) or np.any(np.sign(exposure_arc) != np.sign(exposure_arc[0])):
        found = f"arcs from {exposure_arc.min():.6g} to {exposure_arc.max():.6g} rad"
        raise InputError(f"{subject} exposure", found, "arcs that turn one way, none of them 0")
    ratio = readout_arc / exposure_arc
    if ratio.min() < 0 or np.ptp(ratio) > _SAME * max(1.0, ratio.max()):
        found = f"readout over exposure from {ratio.min():.6g} to {ratio.max():.6g}"
        raise InputError(f"{subject} readout", found, "one ratio of at least 0 for all frames")
    first_rad = marks_rad[:, 0]
    speed_rad_per_s = float(np.mean(exposure_arc)) / exposure_s
    return exposure_s, float(np.median(ratio)) * exposure_s, (first_rad - first_rad[0]) / speed_rad_per_s
