"""Gaussians trained on a fly-scan by a loop of one's own, in PyTorch: python train_own.py scan.h5 volume.h5 [steps]"""

import sys

import numpy as np
import torch
from torch.nn.functional import softplus

from phyradgs_cl.api import Gaussians, Reconstruction, compare, initial_gaussians, load_scan, save_volume
from phyradgs_cl.api import as_torch, splat_operator, voxel_operator, voxelise

RATES = {"mean": 2e-3, "scale": 2e-2, "turn": 1e-2, "density": 6e-2}  # fall to a tenth


def train(scan, steps, smoothness=0.02, seed=0):
    """The cloud that explains the frames: mean absolute misfit of one frame a step, and little total variation."""
    project, field = as_torch(splat_operator(scan, "exact")), as_torch(voxel_operator(scan.grid))
    measured = torch.from_numpy(scan.projections)
    start = initial_gaussians(scan, seed=seed)
    half_mm, peak = scan.grid.half_longest_mm, float(start.density.max()) / 0.15
    raw = {
        "mean": start.mean.T / half_mm,
        "scale": np.log(start.scale.T / half_mm),
        "turn": start.quaternion.T,
        "density": np.log(np.expm1(start.density[None] / peak)),
    }
    raw = {name: torch.tensor(values, dtype=torch.float32, requires_grad=True) for name, values in raw.items()}
    adam = torch.optim.Adam([{"params": [raw[name]], "lr": rate} for name, rate in RATES.items()], eps=1e-15)
    decay = torch.optim.lr_scheduler.ExponentialLR(adam, 0.1 ** (1 / steps))

    def rows():
        return torch.cat([half_mm * raw["mean"], half_mm * raw["scale"].exp(), raw["turn"], peak * softplus(raw["density"])])

    order = np.random.default_rng(seed)
    for step in range(steps):
        if step % scan.frames == 0:
            frames = order.permutation(scan.frames)
        frame, now = int(frames[step % scan.frames]), rows()
        loss = (project(now, frames=[frame])[0] - measured[frame]).abs().mean() / (half_mm * peak)
        if step % 8 == 0:
            volume = field(now) / peak
            loss = loss + 8 * smoothness * sum(volume.diff(dim=k).abs().mean() for k in range(3))
        adam.zero_grad()
        loss.backward()
        adam.step()
        decay.step()
        if step%100==0: print(step, loss.item(), flush=True)
    return Gaussians.from_rows(rows().detach().numpy().astype(float))


if __name__ == "__main__":
    scan = load_scan(sys.argv[1])
    cloud = train(scan, int(sys.argv[3]) if len(sys.argv) > 3 else 2000)
    result = Reconstruction(voxelise(cloud, scan.grid), scan.grid, cloud)
    print(f"PSNR {compare(result.volume, scan.reference)['psnr_db']:.2f} dB")
    save_volume(sys.argv[2], result)
