"""The readers of the package that are not HDF5's, on one file or folder: what `worker` calls, by name."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from phyradgs_cl.importers import ImportOptions, import_scan
from phyradgs_cl.io import load_scanner, read_checkpoint
from phyradgs_cl.io.json_lines import read_lines
from phyradgs_cl.settings import read_config
from phyradgs_cl.workflow.sweep import read_grid

DATA = Path("/nowhere")


@dataclass(frozen=True)
class Reader:
    """``read`` is called on a copy of the good file ``of``, of which the file ``inside`` has been changed."""

    of: str
    read: Callable[[Path], object]
    inside: str = ""

    def content(self, good: Path) -> bytes:
        """What is changed, as it is in the folder ``good``."""
        return (good / self.of / self.inside if self.inside else good / self.of).read_bytes()


def _import(form: str) -> Callable[[Path], object]:
    options = {
        "phyradgs-real": ImportOptions(pixel_size_mm=(3.0, 2.5)),
    }
    return lambda path: import_scan(path, options.get(form), form)


def _sweep(folder: Path) -> object:
    path = folder / "grid.toml"
    return read_grid(read_config(path, "GRID"), path)


def _checkpoint(path: Path) -> object:
    return read_checkpoint(path)


READERS: dict[str, Reader] = {
    "scanner": Reader("scanner.toml", lambda path: load_scanner(path, DATA)),
    "configuration": Reader("run.toml", read_config),
    "sweep": Reader("sweep", _sweep, "grid.toml"),
    "checkpoint": Reader("phyradgs.checkpoint.npz", _checkpoint),
    "results": Reader("results.jsonl", read_lines),
    "import of r2, JSON": Reader("r2", _import("r2"), "meta_data.json"),
    "import of r2, npy": Reader("r2", _import("r2"), "proj_train/0000.npy"),
    "import of real": Reader("real", _import("phyradgs-real"), "geometric_motion_rs.json"),
    "import of rtk, XML": Reader("rtk", _import("rtk"), "geometry.xml"),
    "import of rtk, MHA": Reader("rtk", _import("rtk"), "projections.mha"),
    "import of tiff, TIFF": Reader("tiff", _import("tiff"), "proj_1.tif"),
    "import of tiff, TOML": Reader("tiff", _import("tiff"), "scan.toml"),
    "import of naf": Reader("chest.pickle", _import("naf")),
}


def changed_copy(reader: Reader, good: Path, folder: Path, content: bytes) -> Path:
    """The good file with ``content`` in place of what is changed, in ``folder``, which is emptied first."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    path = folder / reader.of
    (shutil.copytree if (good / reader.of).is_dir() else shutil.copy)(good / reader.of, path)
    (path / reader.inside if reader.inside else path).write_bytes(content)
    return path
