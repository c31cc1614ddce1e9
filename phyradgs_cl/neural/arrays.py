"""NumPy arrays to tensors and back by DLPack, since the two packages need not know each other's versions."""

import numpy as np
import torch


def to_tensor(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """A tensor of the array's own type and shape on ``device``; never the array's memory."""
    return torch.from_dlpack(np.array(array, order="C")).to(device)


def to_array(tensor: torch.Tensor) -> np.ndarray:
    """An array of the tensor's values, of the same type and shape."""
    return np.from_dlpack(tensor.detach().to("cpu").contiguous()).copy()
