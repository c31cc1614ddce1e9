"""The methods by name, and the user's own. A new method is a file with a METHOD, and a line in METHODS."""

from collections import UserDict
from importlib import import_module
from typing import Any

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.reconstructors.method import Method, imported, own_method
from phyradgs_cl.reconstructors.result import function_name
from phyradgs_cl.text import suggest_name


class _Methods(UserDict[str, Any]):
    """Methods by name, each imported when it is first used: imports take time."""

    def __getitem__(self, name: str) -> Method:
        entry = self.data[name]
        if isinstance(entry, str):
            module, _, attribute = entry.partition(":")
            entry = getattr(import_module(f"phyradgs_cl.reconstructors.{module}"), attribute or "METHOD")
            self.data[name] = entry
        return entry


DEFAULT_METHOD = "fista"
METHODS = _Methods({
    "phyradgs": "splats.method:PHYRADGS",
    "r2": "splats.method:R2",
    "sart": "voxels.sart",
    "os-sart": "voxels.sart:OS_METHOD",
    "sirt": "voxels.sirt",
    "cgls": "voxels.cgls",
    "asd-pocs": "voxels.asd_pocs",
    "fista": "voxels.fista",
    "fista-tv": "voxels.fista_tv",
    "naf": "neural:NAF",
    "sax-nerf": "neural:SAX_NERF",
    "fused": "fused",
    "moving": "moving.method",
    "fdk": "fdk",
    "fbp": "fdk:FBP_METHOD",
})


def method_name(method: object) -> str:
    """Returns the name of a method: a key of METHODS, given in any case, or ``package.module:name`` of the user's own.

    Raises InputError for anything else."""
    if isinstance(method, str) and method.lower() in METHODS:
        return method.lower()
    if callable(method):
        return function_name(method)
    if not isinstance(method, str) or ":" not in method:
        expected = f"one of {', '.join(METHODS)}, or package.module:function of your own"
        raise InputError("--method", checks.short_repr(method), expected, suggest_name(method, METHODS, ""))
    return method


def method_of(method: object) -> Method:
    """Returns the method of that name, or the user's own function, given as such or as ``package.module:name``.

    Raises InputError for anything else, and for a function that cannot be imported."""
    name = method_name(method)
    if name in METHODS:
        return METHODS[name]
    return own_method(name, imported(name) if isinstance(method, str) else method)


def usual_preset(method: object) -> str:
    """Returns the name of a method's default preset."""
    return next(iter(method_of(method).presets))
