"""The device that PyTorch works on, and repeatable arithmetic there."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from phyradgs_cl.errors import DeviceError


def torch_device(wish: str) -> torch.device:
    """``cpu``, ``cuda`` (ROCm too), ``mps``, or the first that there is of cuda, mps, cpu for ``auto``.

    Raises DeviceError for a device that this PyTorch does not have.
    """
    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    found = [name for name, is_there in there.items() if is_there]
    if wish == "auto":
        return torch.device(found[0])
    if wish not in found:
        expected = f"one of {', '.join(found)}, or auto"
        raise DeviceError("option torch_device", f"no {wish} in PyTorch {torch.__version__}", expected)
    return torch.device(wish)


@contextmanager
def repeatable(device: torch.device) -> Iterator[None]:
    """While open, PyTorch takes the algorithms that give the same bits again.

    On CPUs the operations of this room have one order of their sums anyway, and the switch would only slow them down.
    """
    if device.type != "cuda":
        yield
        return
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before)
