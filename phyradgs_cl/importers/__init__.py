"""Scans and volumes in other programs' formats, checked as from strangers and turned into our conventions."""

from collections.abc import Callable
from pathlib import Path

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.formats.data_exchange import import_data_exchange
from phyradgs_cl.importers.formats.naf import import_naf
from phyradgs_cl.importers.formats.nxtomo import import_nxtomo
from phyradgs_cl.importers.formats.phyradgs_real import import_phyradgs_real
from phyradgs_cl.importers.formats.phyradgs_synthetic import import_phyradgs
from phyradgs_cl.importers.formats.r2_gaussian import import_r2
from phyradgs_cl.importers.formats.rtk import import_rtk
from phyradgs_cl.importers.formats.tiff_folder import import_tiff
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.recognise import recognise
from phyradgs_cl.importers.volumes import foreign_volume, load_attenuation, load_volume
from phyradgs_cl.io.hdf5.held_warnings import held_warnings

__all__ = [
    "FORMATS", "ImportOptions", "foreign_volume", "import_scan", "load_attenuation", "load_volume",
    "recognise"
]  # fmt: skip

FORMATS: dict[str, Callable[[Path, ImportOptions], Scan]] = {
    "r2": import_r2,
    "phyradgs": import_phyradgs,
    "phyradgs-real": import_phyradgs_real,
    "naf": import_naf,
    "rtk": import_rtk,
    "data-exchange": import_data_exchange,
    "nxtomo": import_nxtomo,
    "tiff": import_tiff,
}


def import_scan(path: str | Path, options: ImportOptions | None = None, form: str | None = None) -> Scan:
    """A scan from a file or folder of another program, with line integrals, row 0 the lowest, in mm, s and radians.

    ``options``: what the files do not say; ``form``: a key of ``FORMATS``, None recognises it. InputError: a format that is
    not known, files that are damaged, incomplete or not what they seem, options that the format has no use for.
    """
    path = Path(path)
    if not (path.is_dir() or path.is_file()):
        found = "something that is neither a file nor a folder" if path.exists() else "nothing there"
        raise InputError(str(path), found, "a scan to import", "check the path")
    form = form or recognise(path)
    checks.one_of("format", form, FORMATS)
    with held_warnings():
        try:
            scan = FORMATS[form](path, options or ImportOptions())
        except InputError as error:
            if not error.culprit.startswith("grid "):
                raise
            raise InputError(f"{path} {error.culprit}", error.found, error.expected, error.remedy) from error
        scan.check_timing()
    return scan
