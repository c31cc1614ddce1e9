"""dask.distributed, imported when it is needed and quiet: what users are to know is said here, not in its logs."""

import importlib.util
import logging
from types import ModuleType

from phyradgs_cl import checks


def has_dask() -> bool:
    """Whether dask.distributed is installed."""
    return importlib.util.find_spec("distributed") is not None


def distributed() -> ModuleType:
    """The package, or an InputError that says how to install it."""
    use = "the package that --scheduler and --workers need"
    package = checks.package("distributed", use, "phyradgs-cl[cluster]")
    for name in list(logging.root.manager.loggerDict):
        if name == "distributed" or name.startswith("distributed."):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    return package
