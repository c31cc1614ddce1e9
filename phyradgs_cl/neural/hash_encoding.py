"""Multi-resolution hash encoding of positions.

Müller, Evans, Schied, Keller, ACM Trans. Graph. 41 (2022) 102; in NAF (Zha, Zhang, Li, MICCAI 2022) in three dimensions."""

from typing import Any

import torch
from torch import nn

_FACTORS = (1, 2_654_435_761, 805_459_861)  # of x, y, z in the hash (Müller et al., Eq. 4)
_FIRST_FEATURES = 1e-4  # uniform in ± this (Müller et al., NAF)


class HashEncoding(nn.Module):
    """Features (P, levels · features) of positions (P, 3) in [0, 1]³, interpolated linearly between a level's corners.

    A level whose corners fit into 2^table_log2 entries has one for each, another shares entries by a hash."""

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
        """Features of a position."""
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
    """Entries (8, P) int64 and weights (8, P) of the corners around positions (P, 3), on a level of ``cells``³ cells."""
    scaled = positions.t() * cells
    low = scaled.floor().clamp_(0, cells - 1)
    high_share = scaled - low  # (3, P)
    low_share = 1 - high_share
    side, whole = cells + 1, low.to(torch.int64)
    is_dense = side**3 <= size
    strides = (1, side, side * side) if is_dense else _FACTORS
    first = [whole[axis] * stride for axis, stride in enumerate(strides)]
    ends = [torch.stack([start, start + stride]) for start, stride in zip(first, strides, strict=True)]
    shares = [torch.stack([low_share[axis], high_share[axis]]) for axis in range(3)]
    x, y, z = (ends[axis].reshape(_corner_shape(axis)) for axis in range(3))
    index = x + y + z if is_dense else (x ^ y ^ z) % size
    wx, wy, wz = (shares[axis].reshape(_corner_shape(axis)) for axis in range(3))
    return index.reshape(8, -1), (wx * wy * wz).reshape(8, -1)


def _corner_shape(axis: int) -> tuple[int, int, int, int]:
    return (2 if axis == 2 else 1, 2 if axis == 1 else 1, 2 if axis == 0 else 1, -1)


def weighted_rows(table: torch.Tensor, index: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Σ weight · table[index] over the last axis of index (B, 8): ``embedding_bag``, which some devices lack."""
    rows = table.index_select(0, index.reshape(-1)).reshape(*index.shape, table.shape[1])
    return torch.einsum("bkf,bk->bf", rows, weight)


class _Interpolate(torch.autograd.Function):
    """Σ weight · table[index] over the 8 corners (B, 8) of each bag; the gradient sums into the table in one fixed order."""

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
            share = (weight * by_features[:, number, None]).reshape(-1)
            gradient.scatter_add_(0, first + number, share)
        return gradient.reshape(ctx.entries, features), None, None
