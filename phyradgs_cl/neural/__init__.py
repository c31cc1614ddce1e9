"""Attenuation as a neural field: hash encoding, networks, rays over an exposure, training. The only room built on PyTorch.

PyTorch is an optional package: this module and ``options`` load without it, the others need it.
"""

import importlib.util

from phyradgs_cl.errors import InputError
from phyradgs_cl.neural.options import LineOptions, NeuralOptions

__all__ = ["INSTALL", "LineOptions", "NeuralOptions", "has_accelerator", "has_torch", "require_torch"]
INSTALL = 'pip install "phyradgs-cl[neural]"'


def has_torch() -> bool:
    """Whether the package torch can be imported."""
    return importlib.util.find_spec("torch") is not None


def has_accelerator() -> bool:
    """Whether PyTorch is there and has something faster than a CPU."""
    if not has_torch():
        return False
    from phyradgs_cl.neural.tensors import torch_device

    return torch_device("auto").type != "cpu"


def require_torch(subject: str) -> None:
    """Raise InputError that says what to install, unless PyTorch is there."""
    if not has_torch():
        raise InputError(subject, "no PyTorch", "the package torch", INSTALL)
