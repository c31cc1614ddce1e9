"""Attenuation as a neural field: hash encoding, networks, rays over an exposure, training. The only room built on PyTorch.

PyTorch is an optional package: this module and ``options`` load without it, the others need it.
"""

from phyradgs_cl.neural.options import LineOptions, NeuralOptions
from phyradgs_cl.neural.requirement import has_accelerator, has_torch, require_torch

__all__ = ["LineOptions", "NeuralOptions", "has_accelerator", "has_torch", "require_torch"]
