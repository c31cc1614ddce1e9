"""The field that is fitted: positions in the volume's cube to attenuation, over all of a grid's voxels where asked."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from phyradgs_cl.fields import Grid
from phyradgs_cl.neural.arrays import to_array, to_tensor
from phyradgs_cl.neural.attenuation_network import AttenuationNetwork
from phyradgs_cl.neural.hash_encoding import HashEncoding


class NeuralField(nn.Module):
    """Attenuation (P,) of positions (P, 3) x y z, in [−1, 1] along the longest side of the volume.

    ``segment``: neighbours among the positions that belong together; 1 where every position stands for itself.
    """

    def __init__(self, encoding: HashEncoding, network: AttenuationNetwork, segment: int = 1) -> None:
        super().__init__()
        self.encoding, self.network, self.segment = encoding, network, segment

    def forward(self, positions: torch.Tensor) -> torch.Tensor:
        return self.network(self.encoding(((positions + 1) / 2).clamp(0, 1)))


@torch.no_grad()
def voxel_values(field: NeuralField, grid: Grid, device: torch.device, points_at_once: int) -> np.ndarray:
    """The field at the centres of all voxels (nz, ny, nx) float32; ``grid`` in units of half the longest side, centred.

    It is asked brick by brick. Where positions belong together, the voxels of a segment are neighbours along x, and a
    row's last segment is filled up beyond its end.
    """
    z, y, x = grid.axes_mm()
    filled = -(-x.size // field.segment) * field.segment
    x = np.concatenate([x, x[-1] + grid.voxel_size_mm[2] * np.arange(1, filled - x.size + 1)])
    rows = np.stack(np.meshgrid(z, y, indexing="ij"), -1).reshape(-1, 2)  # of voxels along x
    values = np.empty((len(rows), filled), np.float32)
    at_once = max(points_at_once // filled, 1)
    for start in range(0, len(rows), at_once):
        part = rows[start : start + at_once]
        positions = np.empty((len(part), filled, 3), np.float32)
        positions[..., 0], positions[..., 1], positions[..., 2] = x, part[:, 1:], part[:, :1]
        brick = field(to_tensor(positions.reshape(-1, 3), device))
        values[start : start + at_once] = to_array(brick).reshape(len(part), filled)
    return np.ascontiguousarray(values.reshape(*grid.shape[:2], filled)[..., : grid.shape[2]])
