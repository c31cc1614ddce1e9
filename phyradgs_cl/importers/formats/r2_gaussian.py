"""Folders of R2-Gaussian: meta_data.json with .npy projections and the true volume; taken at rest. Its frame is TIGRE's,
which PhyRadGS and NAF share: projections [v, u] with row 0 at +z, volumes [x, y, z]."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, Scan
from phyradgs_cl.acquisition.geometry import ConeGeometry, Geometry, ParallelGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.importers.assemble import Timing, assemble_scan, make_timing, turning
from phyradgs_cl.importers.options import TIMING, ImportOptions
from phyradgs_cl.importers.reading.files import SafeFolder, read_json, read_npy
from phyradgs_cl.importers.reading.frames import line_integrals, oriented
from phyradgs_cl.io.scan import BEAMS
from phyradgs_cl.io.tables import Fields

META = "meta_data.json"
META_WITH_TIMES = "meta_data_motion_blur_rolling_shutter_fps18.json"  # in folders of PhyRadGS
ROW_0 = "top"
OPTIONS = (*TIMING, "unit_mm", "detector_model", "part")


@dataclass(frozen=True, eq=False)
class R2Folder:
    """An opened folder with its description and geometry."""

    folder: SafeFolder
    meta: Fields
    geometry: Geometry
    unit_mm: float

    @classmethod
    def opened(cls, given: Path, usual: str, unit_mm: float) -> "R2Folder":
        """Reads the description named ``usual`` of a folder, or ``given`` if that is a description."""
        folder = SafeFolder(given if given.is_dir() else given.parent)
        name = usual if given.is_dir() else given.name
        path = folder.file(name, str(folder.root / name))
        meta = Fields(f"{path}:", read_json(path))
        return cls(folder, meta, read_geometry(meta.table("scanner"), unit_mm), unit_mm)

    def frame(self, entry: Fields) -> np.ndarray:
        """Reads one projection (v, u) as stored."""
        name = entry.word("file_path")
        first_copy = name.replace("_sim1", "")  # of a repeated simulation, whose first copy was kept
        path = self.folder.file(first_copy if self.folder.exists(first_copy) else name, entry.name("file_path"))
        image = read_npy(path, 2)
        checks.shape(str(path), image, self.geometry.detector_shape)
        return image

    def scan(
        self, path: Path, entries: list[Fields], orbit: CircularOrbit, timing: Timing, options: ImportOptions
    ) -> Scan:
        """Returns the scan of the listed frames along ``orbit``, with the truth in 1/mm where the folder has it."""
        grid, reference = read_grid(self.meta.table("scanner"), self.unit_mm), None
        if self.meta.has("vol"):
            truth = self.folder.file(self.meta.word("vol"), self.meta.name("vol"))
            reference = turned_volume(str(truth), read_npy(truth, 3), grid, 1 / self.unit_mm)
        names = [entry.word("file_path") for entry in entries]
        if twice := [i for i, name in enumerate(names) if name in names[:i]]:
            raise InputError(entries[twice[0]].name("file_path"), f"{names[twice[0]]!r} again", "every frame once")
        frames = oriented(np.stack([self.frame(entry) for entry in entries]), options, ROW_0)
        integrals = line_integrals(str(self.folder.root), frames, options, convention="attenuation")
        parts = integrals, orbit, self.geometry, timing, options
        title = path.resolve().name
        return assemble_scan(*parts, title=title, source=str(path), grid=grid, reference=reference)


def entries_of(meta: Fields, prefix: str, part: str) -> list[Fields]:
    """Returns the entries of a part; "all" means train, then test."""
    parts = ("train", "test") if part == "all" else (part,)
    return [entry for name in parts for entry in meta.tables(f"{prefix}{name}")]


def recognises(path: Path) -> bool:
    """True for a folder with R2-Gaussian's description, and for the description itself."""
    if path.is_dir():
        return (path / META).exists() and not (path / META_WITH_TIMES).exists()
    return path.name == META


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports the ``proj_train`` (or test, or all) frames of a folder."""
    options.refuse_unused("r2", OPTIONS)
    opened = R2Folder.opened(path, META, options.unit_mm)
    entries = entries_of(opened.meta, "proj_", options.part)
    angle_rad = np.array([entry.number("angle") for entry in entries])
    timing = make_timing(str(path), len(entries), options)
    return opened.scan(path, entries, turning(opened.geometry, angle_rad, timing), timing, options)


def read_geometry(scanner: Fields, unit_mm: float) -> Geometry:
    """Reads the beam of a scanner's table, lengths in ``unit_mm``; "Detector" values run [v, u], ``offDetector`` [u, v].
    TIGRE does not use the distances of mode "parallel"."""
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
    """Reads the voxel grid of a scanner's table, whose triples run [x, y, z]."""
    counts = scanner.counts("nVoxel", 3)
    size = _pitches(scanner, "Voxel", counts) * unit_mm
    origin = _offset(scanner, "offOrigin", 3) * unit_mm
    return Grid(triple(counts[::-1]), triple(size[::-1].tolist()), triple(origin[::-1].tolist()))


def _pitches(scanner: Fields, what: str, counts: tuple[int, ...]) -> np.ndarray:
    """Returns the size of a pixel or voxel along each axis: dDetector or dVoxel, else sDetector or sVoxel over the count."""
    if scanner.has(f"d{what}"):
        return scanner.lengths(f"d{what}", len(counts))
    return scanner.lengths(f"s{what}", len(counts)) / np.array(counts)


def _offset(scanner: Fields, key: str, count: int) -> np.ndarray:
    """Returns (count,) lengths, 0 where the table has none; a third number of offDetector is not used."""
    if not scanner.has(key):
        return np.zeros(count)
    values = scanner.numbers(key)
    if len(values) < count:
        raise scanner.error(key, f"{len(values)} values", f"{count} numbers")
    return values[:count]


def turned_volume(subject: str, volume: np.ndarray, grid: Grid, per_mm: float) -> np.ndarray:
    """Returns a stored volume [x, y, z] as (z, y, x) float32 in 1/mm."""
    checks.shape(subject, volume, grid.shape[::-1])
    checks.finite(subject, volume)
    turned = np.transpose(volume, (2, 1, 0)).astype(np.float64) * per_mm
    if (largest := float(np.abs(turned).max())) > float(np.finfo(np.float32).max):
        raise InputError(subject, f"a density of {largest:.3g} 1/mm", "one that float32 holds", "check the file")
    return np.ascontiguousarray(turned, np.float32)
