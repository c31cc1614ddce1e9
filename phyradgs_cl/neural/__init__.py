"""Attenuation as a neural field: hash encoding, networks, rays over an exposure, training.

PyTorch is optional, and only this folder uses it. This module and ``options`` load without PyTorch; the others need it."""

import importlib.util

from phyradgs_cl.errors import InputError
from phyradgs_cl.neural.options import LineOptions, NeuralOptions

__all__ = ["INSTALL", "LineOptions", "NeuralOptions", "has_torch", "require_torch"]
INSTALL = 'pip install "phyradgs-cl[neural]"'


def has_torch() -> bool:
    return importlib.util.find_spec("torch") is not None


def require_torch(subject: str) -> None:
    """Raises InputError, which names the missing package, where PyTorch cannot be imported. subject: what needs it."""
    if not has_torch():
        raise InputError(subject, "no PyTorch", "the package torch", INSTALL)
