"""Packages that only some exports need."""

from __future__ import annotations

import importlib
from types import ModuleType

from phyradgs_cl.errors import InputError


def needed(name: str) -> ModuleType:
    """The imported package, or an InputError that says how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        remedy = "pip install 'phyradgs-cl[formats]'"
        raise InputError(name, "not installed", "the package that this export needs", remedy) from error
