"""NAF's network: a position's features to its attenuation.

Zha, Zhang, Li, "NAF: Neural Attenuation Fields for Sparse-View CBCT Reconstruction", MICCAI 2022.
"""

import math

import torch
from torch import nn

from phyradgs_cl.neural.field.line_attention import LineAttentionBlocks
from phyradgs_cl.neural.options import LineOptions, NeuralOptions


class AttenuationNetwork(nn.Module):
    """Attenuation (P,) from features (P, inputs), in the units of ``options.density_bound``.

    ``middle`` are the modules between the first and the last layer, ``skip`` the place among all layers where the
    features come in again; leaky ReLU follows every layer but the last.
    """

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


def skip_layer(layers: int) -> int:
    """The middle one, where the encoding comes in again: the third of NAF's four; 0, which is none, below three."""
    return layers // 2 if layers > 2 else 0


def naf_network(inputs: int, options: NeuralOptions) -> AttenuationNetwork:
    """Linear layers only."""
    skip, width = skip_layer(options.layers), options.width
    middle: list[nn.Module] = [
        nn.Linear(width + inputs if number == skip else width, width)
        for number in range(1, options.layers - 1)
    ]
    return AttenuationNetwork(inputs, middle, skip, options)


def sax_network(inputs: int, options: LineOptions) -> AttenuationNetwork:
    """Line-segment attention in the place of every linear layer in the middle but the one after the skip."""
    skip, width = skip_layer(options.layers), options.width
    middle: list[nn.Module] = [
        nn.Linear(width + inputs, width)
        if number == skip
        else LineAttentionBlocks(width, options.segment, options.heads, options.head_width, options.blocks)
        for number in range(1, options.layers - 1)
    ]
    return AttenuationNetwork(inputs, middle, skip, options)
