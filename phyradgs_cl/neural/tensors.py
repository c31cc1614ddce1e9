"""PyTorch's devices and tensors: the device that a run works on, repeatable arithmetic, NumPy's arrays by DLPack."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from phyradgs_cl.errors import DeviceError


def torch_device(name: str) -> torch.device:
    """``cpu``, ``cuda`` (ROCm too), ``mps``, or for ``auto`` the first available of cuda, mps, cpu.

    Raises DeviceError for a device that this PyTorch does not have."""
    is_available = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    available = [device for device, is_there in is_available.items() if is_there]
    if name == "auto":
        return torch.device(available[0])
    if name not in available:
        expected = f"one of {', '.join(available)}, or auto"
        raise DeviceError("option torch_device", f"no {name} in PyTorch {torch.__version__}", expected)
    return torch.device(name)


@contextmanager
def repeatable(device: torch.device) -> Iterator[None]:
    """Makes PyTorch use algorithms that give the same bits in every run.

    On CPUs the sums of this room have a fixed order anyway, and the switch would only slow them down."""
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


def to_tensor(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """A tensor of the array's own type and shape on ``device``; never the array's memory."""
    return torch.from_dlpack(np.array(array, order="C")).to(device)


def to_array(tensor: torch.Tensor) -> np.ndarray:
    """An array of the tensor's values, of the same type and shape."""
    return np.from_dlpack(tensor.detach().to("cpu").contiguous()).copy()
