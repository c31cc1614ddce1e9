"""dask.distributed, imported when it is needed and quiet: what users are to know is said here, not in its logs."""

from __future__ import annotations

import importlib
import importlib.util
import logging
from types import ModuleType

from phyradgs_cl.errors import InputError


def has_dask() -> bool:
    """Whether dask.distributed is installed."""
    return importlib.util.find_spec("distributed") is not None


def distributed() -> ModuleType:
    """The package, or an InputError that says how to install it."""
    try:
        package = importlib.import_module("distributed")
    except ImportError as error:
        remedy = "pip install 'phyradgs-cl[cluster]'"
        found = "not installed"
        raise InputError(
            "dask.distributed", found, "the package that --scheduler and --workers need", remedy
        ) from error
    for name in list(logging.root.manager.loggerDict):
        if name == "distributed" or name.startswith("distributed."):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    return package
