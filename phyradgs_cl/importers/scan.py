"""A scan of another program, by the function of formats/ that reads it."""

from importlib import import_module
from pathlib import Path

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.recognise import recognise

# by name: the function of formats/ that reads it, imported when it is asked for
FORMATS = {
    "r2": "r2_gaussian.import_r2",
    "phyradgs": "phyradgs_synthetic.import_phyradgs",
    "phyradgs-real": "phyradgs_real.import_phyradgs_real",
    "naf": "naf.import_naf",
    "rtk": "rtk.import_rtk",
    "data-exchange": "data_exchange.import_data_exchange",
    "nxtomo": "nxtomo.import_nxtomo",
    "tiff": "tiff_folder.import_tiff",
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
    module, _, function = FORMATS[form].partition(".")
    room = import_module(f"phyradgs_cl.importers.formats.{module}")
    try:
        scan: Scan = getattr(room, function)(path, options or ImportOptions())
    except InputError as error:
        if not error.subject.startswith("grid "):
            raise
        raise InputError(f"{path} {error.subject}", error.found, error.expected, error.remedy) from error
    scan.check_timing()
    return scan
