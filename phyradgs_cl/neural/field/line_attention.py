"""SAX-NeRF's line-segment transformer: attention among the samples of one short piece of a ray.

Cai, Wang, Yuille, Zhou, Wang, "Structure-Aware Sparse-View X-ray 3D Reconstruction", CVPR 2024.
"""

import torch
from torch import nn

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
                nn.LayerNorm(width),
                nn.Linear(width, _WIDER * width, bias=False),
                nn.GELU(),
                nn.Linear(_WIDER * width, _WIDER * width, bias=False),
                nn.GELU(),
                nn.Linear(_WIDER * width, width, bias=False),
            )
            for _ in range(blocks)
        )

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        for attention, feed_forward in zip(self.attention, self.feed_forward, strict=True):
            values = values + attention(values)
            values = values + feed_forward(values)
        return values
