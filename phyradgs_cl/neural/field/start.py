"""The fields of the two methods, with their first random parameters."""

import torch

from phyradgs_cl.neural.field.attenuation_network import naf_network, sax_network
from phyradgs_cl.neural.field.hash_encoding import HashEncoding
from phyradgs_cl.neural.field.on_grid import NeuralField
from phyradgs_cl.neural.options import LineOptions, NeuralOptions


def first_field(options: NeuralOptions, longest_voxels: int, seed: int) -> NeuralField:
    """SAX-NeRF's field for its options, NAF's for others, of a volume of so many voxels along its longest side.

    The same seed gives the same parameters, on every device.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoding = HashEncoding(
            options.levels_for(longest_voxels),
            options.features,
            options.base_resolution,
            options.level_growth,
            options.table_log2,
        )
        if isinstance(options, LineOptions):
            return NeuralField(encoding, sax_network(encoding.width, options), options.segment)
        return NeuralField(encoding, naf_network(encoding.width, options))
