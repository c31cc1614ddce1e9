"""Folders of R2-Gaussian: meta_data.json beside .npy projections and the true volume; taken at rest."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import CircularOrbit, Scan
from phyradgs_cl.acquisition.geometry import ConeGeometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers.formats import tigre_frame
from phyradgs_cl.importers.options import TIMING, ImportOptions
from phyradgs_cl.importers.reading.bounded import read_json, read_npy
from phyradgs_cl.importers.reading.folder import SafeFolder
from phyradgs_cl.importers.reading.frames import LineIntegrals, line_integrals, oriented
from phyradgs_cl.importers.scan_parts import put_together
from phyradgs_cl.importers.timing import Timing, make_timing, turning
from phyradgs_cl.io.tables import Fields

META = "meta_data.json"
OPTIONS = (*TIMING, "unit_mm", "detector_model", "part")


@dataclass(frozen=True, eq=False)
class R2Folder:
    """An opened folder: its description, geometry and where the truth is."""

    folder: SafeFolder
    meta: Fields
    geometry: ConeGeometry
    unit_mm: float

    @classmethod
    def opened(cls, given: Path, usual: str, unit_mm: float) -> "R2Folder":
        """Read the description called ``usual`` of a folder, or the description that is given itself."""
        folder = SafeFolder(given if given.is_dir() else given.parent)
        name = usual if given.is_dir() else given.name
        path = folder.file(name, str(folder.root / name))
        meta = Fields(f"{path}:", read_json(path))
        return cls(folder, meta, tigre_frame.read_geometry(meta.table("scanner"), unit_mm), unit_mm)

    def frame(self, entry: Fields) -> np.ndarray:
        """One projection (v, u) as stored."""
        name = entry.word("file_path")
        simulated = name.replace("_sim1", "")  # a repeated simulation whose first copy was kept
        path = self.folder.root / simulated
        chosen = simulated if simulated != name and path.exists() else name
        image = read_npy(self.folder.file(chosen, entry.name("file_path")), 2)
        checks.shape(str(self.folder.root / chosen), image, self.geometry.detector_shape)
        return image

    def projections(self, entries: list[Fields], options: ImportOptions) -> LineIntegrals:
        """Line integrals of the listed frames, row 0 the lowest."""
        names = [entry.word("file_path") for entry in entries]
        if len(set(names)) < len(names):  # a short list must not ask for more memory than its files hold
            at = next(i for i, name in enumerate(names) if name in names[:i])
            raise InputError(entries[at].name("file_path"), f"{names[at]!r} again", "every frame once")
        first = self.frame(entries[0])
        frames = np.empty((len(entries), *first.shape), first.dtype)
        for index, entry in enumerate(entries):
            frames[index] = self.frame(entry)
        oriented_frames = oriented(frames, options, tigre_frame.ROW_0)
        return line_integrals(str(self.folder.root), oriented_frames, options, custom="attenuation")

    def reference(self) -> tuple[Grid, np.ndarray | None]:
        """The grid, and the true volume in 1/mm where the folder has it."""
        grid = tigre_frame.read_grid(self.meta.table("scanner"), self.unit_mm)
        if not self.meta.has("vol"):
            return grid, None
        path = self.folder.file(self.meta.word("vol"), self.meta.name("vol"))
        volume = read_npy(path, 3)
        return grid, tigre_frame.turned_volume(str(path), volume, grid, 1 / self.unit_mm)

    def scan(
        self, path: Path, entries: list[Fields], orbit: CircularOrbit, timing: Timing, options: ImportOptions
    ) -> Scan:
        """The listed frames along ``orbit``, with the truth."""
        grid, reference = self.reference()
        integrals, title = self.projections(entries, options), path.resolve().name
        found = {"title": title, "source": str(path), "grid": grid, "reference": reference}
        return put_together(integrals, orbit, self.geometry, timing, options, **found)  # type: ignore[arg-type]


def entries_of(meta: Fields, prefix: str, part: str) -> list[Fields]:
    """The frames of a part, "all" meaning train, then test."""
    parts = ("train", "test") if part == "all" else (part,)
    return [entry for name in parts for entry in meta.tables(f"{prefix}{name}")]


def import_r2(path: Path, options: ImportOptions) -> Scan:
    """A folder's ``proj_train`` (or test, or all) frames."""
    options.refuse_unused("r2", OPTIONS)
    opened = R2Folder.opened(path, META, options.unit_mm)
    entries = entries_of(opened.meta, "proj_", options.part)
    angle_rad = np.array([entry.number("angle") for entry in entries])
    timing = make_timing(str(path), len(entries), options)
    return opened.scan(path, entries, turning(opened.geometry, angle_rad, timing), timing, options)
