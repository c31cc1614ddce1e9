"""The networks from a position's features to its attenuation: NAF's, and SAX-NeRF's with attention along line segments.

Zha, Zhang, Li, "NAF: Neural Attenuation Fields for Sparse-View CBCT Reconstruction", MICCAI 2022. Cai, Wang, Yuille, Zhou,
Wang, "Structure-Aware Sparse-View X-ray 3D Reconstruction", CVPR 2024."""

import math

import torch
from torch import nn

from phyradgs_cl.neural.options import LineOptions, NeuralOptions

_WIDER = 4  # of the feed-forward layers


class LineAttention(nn.Module):
    """Multi-head attention within segments of ``segment`` neighbours of (P, width); P is a multiple of it."""

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
        likeness = (query.unsqueeze(2) * key.unsqueeze(1)).sum(-1)  # (L, segment, segment, heads)
        share = (likeness + self.position.permute(1, 2, 0)).softmax(2)
        mixed = (share.unsqueeze(-1) * value.unsqueeze(1)).sum(2)
        return self.to_output(mixed.reshape(values.shape[0], -1))

    def _by_head(self, values: torch.Tensor) -> torch.Tensor:
        """(P, inner) as (P / segment, segment, heads, head_width)."""
        return values.reshape(-1, self.segment, self.heads, values.shape[1] // self.heads)


class LineAttentionBlocks(nn.Module):
    """Attention and feed-forward layers in turn, each after a layer norm and beside an identity; (P, width) to the same."""

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
    """Attenuation (P,) from features (P, inputs), in the units of ``options.density_bound``.

    ``middle`` are the modules between the first and the last layer, ``skip`` the place among all layers where the
    features come in again; leaky ReLU follows every layer but the last."""

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
    """Returns NAF's linear layers; for ``LineOptions`` line-segment attention takes the place of every one in the middle but
    the one after the skip. There, in the middle of three and more layers, the encoding comes in again."""
    skip, width = options.layers // 2 if options.layers > 2 else 0, options.width
    middle: list[nn.Module] = []
    for number in range(1, options.layers - 1):
        if isinstance(options, LineOptions) and number != skip:
            middle.append(LineAttentionBlocks(width, options.segment, options.heads, options.head_width, options.blocks))
        else:
            middle.append(nn.Linear(width + inputs if number == skip else width, width))
    return AttenuationNetwork(inputs, middle, skip, options)
