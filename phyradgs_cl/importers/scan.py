"""Scans of other programs: each format's module recognises and imports its own files."""

from importlib import import_module
from pathlib import Path
from types import ModuleType

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.reading import tiff
from phyradgs_cl.importers.reading.files import SafeFolder

# The module of formats/ by the format's name, loaded when it is needed. It has two functions:
# recognises(path) -> bool of a file or folder, and import_scan(path, options) -> Scan.
FORMATS = {
    "r2": "r2_gaussian",
    "phyradgs": "phyradgs_synthetic",
    "phyradgs-real": "phyradgs_real",
    "naf": "naf",
    "rtk": "rtk",
    "data-exchange": "data_exchange",
    "nxtomo": "nxtomo",
    "tiff": "tiff_folder",
}


def import_scan(path: str | Path, options: ImportOptions | None = None, form: str | None = None) -> Scan:
    """Imports a file or folder of another program as a scan of line integrals, row 0 the lowest, in mm, s and radians.

    ``options``: values that the files do not state; ``form``: a key of ``FORMATS``, None recognises it. InputError: an
    unknown format, damaged or incomplete files, options without use for the format. """
    path = Path(path)
    if not (path.is_dir() or path.is_file()):
        found = "something that is neither a file nor a folder" if path.exists() else "nothing there"
        raise InputError(str(path), found, "a scan to import", "check the path")
    form = form or recognise(path)
    checks.one_of("format", form, FORMATS)
    try:
        scan: Scan = _module(form).import_scan(path, options or ImportOptions())
    except InputError as error:
        if not error.subject.startswith("grid "):
            raise
        raise InputError(f"{path} {error.subject}", error.found, error.expected, error.remedy) from error
    scan.check_timing()
    return scan


def recognise(path: Path) -> str:
    """Returns the name of the format of a file or folder, by its content. InputError if none fits, or more than one."""
    if not path.exists():
        raise InputError(str(path), "nothing there", "a scan to import", "check the path")
    if not (path.is_dir() or path.is_file()):
        raise InputError(str(path), "something that is not a regular file", "a file or a folder")
    names = [name for name in FORMATS if _module(name).recognises(path)]
    if len(names) == 1:
        return names[0]
    if not names and _holds_tiffs(path):
        remedy = f"'phyradgs import {path if path.is_dir() else path.parent} --template' prints one to fill in"
        found = "TIFF images and no TOML that describes them"
        raise InputError(str(path), found, "geometry and angles in a TOML beside them", remedy)
    found = f"several: {', '.join(names)}" if names else "no known format"
    raise InputError(str(path), found, "one of the formats of docs/import.md", "say which with --format")


def _module(form: str) -> ModuleType:
    return import_module(f"phyradgs_cl.importers.formats.{FORMATS[form]}")


def _holds_tiffs(path: Path) -> bool:
    if path.is_dir():
        return bool(SafeFolder(path).matching(*tiff.SUFFIXES))
    return path.suffix.lower() in tiff.SUFFIXES
