"""The field that is fitted: it maps positions in the volume's cube to attenuation. Also its first parameters, its values on
a grid, and PyTorch's devices and tensors."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.errors import DeviceError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.neural.networks import AttenuationNetwork, HashEncoding, network_of
from phyradgs_cl.neural.options import LineOptions, NeuralOptions

_ORDERS = ((0, 1, 2), (1, 2, 0), (2, 0, 1))  # orders of a volume's axes z, y, x


def torch_device(name: str) -> torch.device:
    """Returns the device ``cpu``, ``cuda`` (ROCm too) or ``mps``. ``auto`` takes the first available of cuda, mps, cpu.

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

    On CPUs the sums of this room have a fixed order anyway. The switch would only slow them down."""
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
    """Returns a tensor of the array's own type and shape on ``device``. It never shares the array's memory."""
    return torch.from_dlpack(np.array(array, order="C")).to(device)


def to_array(tensor: torch.Tensor) -> np.ndarray:
    """Returns an array of the tensor's values, with the same type and shape."""
    return np.from_dlpack(tensor.detach().to("cpu").contiguous()).copy()


class NeuralField(nn.Module):
    """Maps positions (P, 3), x y z in [−1, 1] along the longest side of the volume, to attenuation (P,).

    segment: the number of neighbouring positions that belong together; 1 where every position stands for itself."""

    def __init__(self, encoding: HashEncoding, network: AttenuationNetwork, segment: int = 1) -> None:
        super().__init__()
        self.encoding, self.network, self.segment = encoding, network, segment

    def forward(self, positions: torch.Tensor) -> torch.Tensor:
        return self.network(self.encoding(((positions + 1) / 2).clamp(0, 1)))


def voxel_values(
    field: NeuralField, grid: Grid, device: torch.device, points_at_once: int, points: int = 1
) -> np.ndarray:
    """Returns the field in all voxels (nz, ny, nx) float32. ``grid``: centred, in units of half the longest side.

    A voxel is the mean over ``points``³ points, the centres of its equal parts. With segments, a point's value depends on
    its neighbours along the segment. It is then the mean over segments along x, y and z."""
    orders = _ORDERS if field.segment > 1 else _ORDERS[:1]
    values = np.zeros(grid.shape, np.float32)
    for order in orders:
        turned = Grid(triple(grid.shape[a] for a in order), triple(grid.voxel_size_mm[a] for a in order))
        part = _in_rows(field, turned, order, device, points_at_once, points)
        values += part.transpose(np.argsort(order))
    return values / np.float32(len(orders))


@torch.no_grad()
def _in_rows(
    field: NeuralField, grid: Grid, order: tuple[int, int, int], device: torch.device, points_at_once: int,
    points: int,
) -> np.ndarray:
    """Returns the voxels of a grid whose axes are z, y, x in another ``order``, with segments along the last axis.

    A row's last segment is filled up beyond the row's end."""
    fine = grid.finer(points)
    slow, middle, fast = fine.axes_mm()
    filled = ceil_div(fast.size, field.segment) * field.segment
    fast = np.concatenate([fast, fast[-1] + fine.voxel_size_mm[2] * np.arange(1, filled - fast.size + 1)])
    slows, middles, fasts = grid.shape
    rows: np.ndarray = np.empty((slows, middles, points, points, 2))  # rows of points, for one row of voxels after the other
    rows[..., 0], rows[..., 1] = slow.reshape(slows, 1, points, 1), middle.reshape(1, middles, 1, points)
    rows = rows.reshape(slows * middles, points**2, 2)
    values = np.empty((slows * middles, fasts), np.float32)
    at_once = max(points_at_once // (filled * points**2), 1)
    for start in range(0, len(rows), at_once):
        part = rows[start : start + at_once].reshape(-1, 2)
        positions = np.empty((len(part), filled, 3), np.float32)
        places = (part[:, :1], part[:, 1:], fast)
        for axis, place in zip(order, places, strict=True):
            positions[..., 2 - axis] = place
        brick: np.ndarray = to_array(field(to_tensor(positions.reshape(-1, 3), device))).reshape(len(part), filled)
        brick = brick[:, : fasts * points].reshape(-1, points**2, fasts, points)
        values[start : start + at_once] = brick.mean((1, 3))
    return values.reshape(grid.shape)


def first_field(options: NeuralOptions, longest_voxels: int, seed: int) -> NeuralField:
    """Returns SAX-NeRF's field for ``LineOptions``, otherwise NAF's, for the number of voxels along a volume's longest side.

    The same seed gives the same parameters on every device."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoding = HashEncoding(
            options.levels_for(longest_voxels), options.features, options.base_resolution,
            options.level_growth, options.table_log2,
        )
        segment = options.segment if isinstance(options, LineOptions) else 1
        return NeuralField(encoding, network_of(encoding.width, options), segment)
