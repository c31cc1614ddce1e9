"""The field that is fitted: a hash encoding of positions, and a network from its features to attenuation. Also its first
parameters, its values on a grid, and PyTorch's devices and tensors.

The networks are NAF's, and SAX-NeRF's with attention along line segments (sources in ``reconstructors/neural.py``). The
encoding is from Müller, Evans, Schied, Keller, ACM Trans. Graph. 41 (2022) 102."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import nn

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.errors import DeviceError
from phyradgs_cl.fields import Grid, triple
from phyradgs_cl.neural.options import LineOptions, NeuralOptions

_ORDERS = ((0, 1, 2), (1, 2, 0), (2, 0, 1))  # orders of a volume's axes z, y, x: line segments run along the last axis
_WIDER = 4  # (width of a transformer's feed-forward layers)/(width of its input and output)
_FACTORS = (1, 2_654_435_761, 805_459_861)  # factors of x, y, z in the hash (Müller et al., Eq. 4)
_FIRST_FEATURES = 1e-4  # initial table entries are random, between −1e-4 and 1e-4 (Müller et al., NAF)


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
    """Makes PyTorch on CUDA use algorithms that give the same bits in every run; changes nothing on other devices. On CPUs
    this package sums in a fixed order anyway, and PyTorch's switch would only slow it down."""
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
    """Copies an array to a tensor of its type and shape on ``device``."""
    return torch.from_dlpack(np.array(array, order="C")).to(device)


def to_array(tensor: torch.Tensor) -> np.ndarray:
    """Copies a tensor to an array of its type and shape."""
    return np.from_dlpack(tensor.detach().to("cpu").contiguous()).copy()


class LineAttention(nn.Module):
    """Multi-head attention within line segments. A segment is a group of ``segment`` successive rows of the values (P,
    width), which belong to successive points of a line. ``segment`` divides P."""

    def __init__(self, width: int, segment: int, heads: int, head_width: int) -> None:
        super().__init__()
        self.segment, self.heads, self.scale = segment, heads, head_width**-0.5
        inner = heads * head_width
        self.position = nn.Parameter(nn.init.trunc_normal_(torch.empty(heads, segment, segment)))
        self.to_query = nn.Linear(width, inner, bias=False)
        self.to_key_value = nn.Linear(width, 2 * inner, bias=False)
        self.to_output = nn.Linear(inner, width)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        query = self._by_head(self.to_query(values)) * self.scale
        key, value = (self._by_head(part) for part in self.to_key_value(values).chunk(2, -1))
        # products of all queries with all keys of a segment, per head: (P / segment, segment, segment, heads)
        likeness = (query.unsqueeze(2) * key.unsqueeze(1)).sum(-1)
        share = (likeness + self.position.permute(1, 2, 0)).softmax(2)
        mixed = (share.unsqueeze(-1) * value.unsqueeze(1)).sum(2)
        return self.to_output(mixed.reshape(values.shape[0], -1))

    def _by_head(self, values: torch.Tensor) -> torch.Tensor:
        """Reshapes values (P, inner) to (P / segment, segment, heads, head_width)."""
        return values.reshape(-1, self.segment, self.heads, values.shape[1] // self.heads)


class LineAttentionBlocks(nn.Module):
    """Alternates attention and feed-forward layers on values (P, width). Each has a layer norm before it and a skip
    connection around it. blocks: number of layers of each kind."""

    def __init__(self, width: int, segment: int, heads: int, head_width: int, blocks: int) -> None:
        super().__init__()
        self.attention = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), LineAttention(width, segment, heads, head_width))
            for _ in range(blocks)
        )
        self.feed_forward = nn.ModuleList(
            nn.Sequential(
                nn.LayerNorm(width), nn.Linear(width, _WIDER * width, bias=False), nn.GELU(),
                nn.Linear(_WIDER * width, _WIDER * width, bias=False), nn.GELU(),
                nn.Linear(_WIDER * width, width, bias=False),
            )
            for _ in range(blocks)
        )

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        for attention, feed_forward in zip(self.attention, self.feed_forward, strict=True):
            values = values + attention(values)
            values = values + feed_forward(values)
        return values


class AttenuationNetwork(nn.Module):
    """Maps features (P, inputs) to attenuation (P,) in the unit of ``options.density_bound``.

    middle: the layers between the first and the last. skip: the index, among all layers, of the layer whose input also
    contains the features; −1: none. ``options.last_activation`` follows the last layer, a leaky ReLU every other layer."""

    def __init__(self, inputs: int, middle: list[nn.Module], skip: int, options: NeuralOptions) -> None:
        super().__init__()
        end = nn.Linear(options.width, 1)
        self.layers = nn.ModuleList([nn.Linear(inputs, options.width), *middle, end])
        self.skip, self.last, self.bound = skip, options.last_activation, options.density_bound
        if self.last == "sigmoid":
            with torch.no_grad():
                end.bias += math.log(options.first_share / (1 - options.first_share))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        values = features
        for number, layer in enumerate(self.layers):
            if number > 0:
                values = nn.functional.leaky_relu(values)
            if number == self.skip:
                values = torch.cat([features, values], -1)
            values = layer(values)
        values = values.squeeze(-1)
        if self.last == "sigmoid":
            return self.bound * torch.sigmoid(values)
        return nn.functional.leaky_relu(values)


def network_of(inputs: int, options: NeuralOptions) -> AttenuationNetwork:
    """Returns NAF's linear layers. Layer number layers // 2, counted from 0, of three or more is the skip layer, whose input
    also contains the features. For ``LineOptions``, attention replaces all layers but the first, the last and this one."""
    skip, width = options.layers // 2 if options.layers > 2 else -1, options.width
    middle: list[nn.Module] = []
    for number in range(1, options.layers - 1):
        if isinstance(options, LineOptions) and number != skip:
            middle.append(LineAttentionBlocks(width, options.segment, options.heads, options.head_width, options.blocks))
        else:
            middle.append(nn.Linear(width + inputs if number == skip else width, width))
    return AttenuationNetwork(inputs, middle, skip, options)


class HashEncoding(nn.Module):
    """Maps positions (P, 3) in [0, 1]³ to features (P, levels · features), interpolated linearly from a grid cell's corners.

    Each level is a finer grid, with base_resolution · growth^level cells along a side. If a level has at most 2^table_log2
    corners, each corner has its own entry in the level's table. Otherwise a hash assigns entries, which corners share."""

    def __init__(
        self, levels: int, features: int, base_resolution: int, growth: float, table_log2: int
    ) -> None:
        super().__init__()
        self.features = features
        self.resolutions = [int(base_resolution * growth**level) for level in range(levels)]
        most = 2**table_log2
        self.sizes = [min((cells + 1) ** 3, most) for cells in self.resolutions]
        first = torch.empty(sum(self.sizes), features).uniform_(-_FIRST_FEATURES, _FIRST_FEATURES)
        self.table = nn.Parameter(first)

    @property
    def width(self) -> int:
        return len(self.sizes) * self.features

    def forward(self, positions: torch.Tensor) -> torch.Tensor:
        indices, weights, start = [], [], 0
        for cells, size in zip(self.resolutions, self.sizes, strict=True):
            index, weight = corners(positions, cells, size)
            indices.append((index + start).t())
            weights.append(weight.t())
            start += size
        encoded = _Interpolate.apply(self.table, torch.cat(indices), torch.cat(weights))
        return encoded.reshape(len(self.sizes), -1, self.features).transpose(0, 1).reshape(-1, self.width)


def corners(positions: torch.Tensor, cells: int, size: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the numbers (8, P) int64 of the table entries of the eight corners around positions (P, 3), and the corners'
    interpolation weights (8, P). The level has ``cells`` grid cells along a side and ``size`` entries."""
    scaled = positions.t() * cells
    low = scaled.floor().clamp_(0, cells - 1)
    high_share = scaled - low  # distance from the cell's lower corner, in sides of a cell, (3, P)
    low_share = 1 - high_share
    side, whole = cells + 1, low.to(torch.int64)
    is_dense = side**3 <= size
    strides = (1, side, side * side) if is_dense else _FACTORS
    first = [whole[axis] * stride for axis, stride in enumerate(strides)]
    (x, wx), (y, wy), (z, wz) = (
        (torch.stack([start, start + stride]), torch.stack([low_share[axis], high_share[axis]]))
        for axis, (start, stride) in enumerate(zip(first, strides, strict=True))
    )
    y, wy, z, wz = y[:, None], wy[:, None], z[:, None, None], wz[:, None, None]
    index = x + y + z if is_dense else (x ^ y ^ z) % size
    return index.reshape(8, -1), (wx * wy * wz).reshape(8, -1)


def weighted_rows(table: torch.Tensor, index: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Returns Σ weight · table[index] over the last axis of index and weight (B, 8), where ``embedding_bag`` is missing."""
    rows = table.index_select(0, index.reshape(-1)).reshape(*index.shape, table.shape[1])
    return torch.einsum("bkf,bk->bf", rows, weight)


class _Interpolate(torch.autograd.Function):
    """Computes Σ weight · table[index] over 8 corners, for index and weight (B, 8). Only the table gets a gradient, which is
    summed in a fixed order, so that every run gives the same bits."""

    @staticmethod
    def forward(ctx: Any, table: torch.Tensor, index: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(index, weight)
        ctx.entries = table.shape[0]
        if table.device.type != "cpu":
            return weighted_rows(table, index, weight)
        return nn.functional.embedding_bag(index, table, mode="sum", per_sample_weights=weight)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_features: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        index, weight = ctx.saved_tensors
        features = by_features.shape[1]
        first = (index * features).reshape(-1)
        gradient = by_features.new_zeros(ctx.entries * features)
        for number in range(features):
            gradient.scatter_add_(0, first + number, (weight * by_features[:, number, None]).reshape(-1))
        return gradient.reshape(ctx.entries, features), None, None


class NeuralField(nn.Module):
    """Maps positions (P, 3), x y z in units of half the volume's longest side about its centre, to attenuation (P,).

    segment: how many successive positions influence each other; 1: none do."""

    def __init__(self, encoding: HashEncoding, network: AttenuationNetwork, segment: int = 1) -> None:
        super().__init__()
        self.encoding, self.network, self.segment = encoding, network, segment

    def forward(self, positions: torch.Tensor) -> torch.Tensor:
        return self.network(self.encoding(((positions + 1) / 2).clamp(0, 1)))


def voxel_values(
    field: NeuralField, grid: Grid, device: torch.device, points_at_once: int, points: int = 1
) -> np.ndarray:
    """Returns the field in all voxels (nz, ny, nx) float32. ``grid``: centred, in units of half the longest side.

    A voxel's value is the mean over the centres of its ``points``³ equal parts. With line segments, a point's value depends
    on the other points of its segment. The result is then the mean of three: for segments along x, y and z. points_at_once:
    most points that are evaluated together."""
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
    """Returns the values of a grid's voxels, with line segments along its last axis. The grid's axes are z, y, x in another
    ``order``. A row of points is extended beyond the grid to fill its last segment."""
    fine = grid.finer(points)
    slow, middle, fast = fine.axes_mm()
    slows, middles, fasts = grid.shape
    filled = ceil_div(fast.size, field.segment) * field.segment
    fast = np.concatenate([fast, fast[-1] + fine.voxel_size_mm[2] * np.arange(1, filled - fast.size + 1)])
    # each row's place on the first two axes: the rows of one voxel follow each other
    rows = np.stack(np.meshgrid(slow, middle, indexing="ij"), -1).reshape(slows, points, middles, points, 2)
    rows = rows.swapaxes(1, 2).reshape(slows * middles, points**2, 1, 2)
    values = np.empty((slows * middles, fasts), np.float32)
    at_once = max(points_at_once // (filled * points**2), 1)
    for start in range(0, len(rows), at_once):
        part = np.broadcast_to(rows[start : start + at_once], (min(at_once, len(rows) - start), points**2, filled, 2))
        places = np.concatenate([part, np.broadcast_to(fast[:, None], (*part.shape[:3], 1))], -1)
        positions = places[..., np.argsort(order)[::-1]].reshape(-1, 3).astype(np.float32)  # x, y, z
        brick: np.ndarray = to_array(field(to_tensor(positions, device))).reshape(*part.shape[:3])
        brick = brick[..., : fasts * points].reshape(-1, points**2, fasts, points)
        values[start : start + at_once] = brick.mean((1, 3))
    return values.reshape(grid.shape)


def first_field(options: NeuralOptions, longest_voxels: int, seed: int) -> NeuralField:
    """Returns SAX-NeRF's field for ``LineOptions``, otherwise NAF's. longest_voxels: voxels along the volume's longest side.

    The same seed gives the same parameters on every device."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoding = HashEncoding(
            options.levels_for(longest_voxels), options.features, options.base_resolution,
            options.level_growth, options.table_log2,
        )
        segment = options.segment if isinstance(options, LineOptions) else 1
        return NeuralField(encoding, network_of(encoding.width, options), segment)
