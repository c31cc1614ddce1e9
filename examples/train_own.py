"""Gaussians trained on a fly-scan by a PyTorch loop: python examples/train_own.py [scan.h5 [steps]]"""

import sys

import numpy as np
import torch

import phyradgs_cl.api as api


def train(scan, steps, smoothness=0.02, seed=0):
    """Fits a cloud to the scan: mean absolute residual of one frame a step, plus total variation."""
    project, field = api.as_torch(api.splat_operator(scan)), api.as_torch(api.voxel_operator(scan.grid))
    start, measured = api.initial_gaussians(scan, seed=seed), torch.tensor(scan.projections)
    length, peak = scan.grid.half_longest_mm, start.density.max() / 0.15  # scales parameters to order 1
    density = np.log(np.expm1(start.density / peak))[None]
    parts = [start.mean.T / length, np.log(start.scale.T / length), start.quaternion.T, density]
    raw = [torch.tensor(part, dtype=torch.float32, requires_grad=True) for part in parts]
    rates = [2e-3, 2e-2, 1e-2, 6e-2]  # at the start, a tenth of them at the end
    adam = torch.optim.Adam([{"params": [part], "lr": rate} for part, rate in zip(raw, rates, strict=True)], eps=1e-15)
    decay = torch.optim.lr_scheduler.ExponentialLR(adam, 0.1 ** (1 / steps))

    def rows():
        mean, scale, turn, density = raw
        return torch.cat([length * mean, length * scale.exp(), turn, peak * torch.nn.functional.softplus(density)])

    rng = np.random.default_rng(seed)
    order = np.concatenate([rng.permutation(scan.frames) for _ in range(steps // scan.frames + 1)])
    for step, frame in enumerate(order[:steps]):
        now = rows()
        loss = (project(now, frames=[frame])[0] - measured[frame]).abs().mean() / (length * peak)
        if step % 8 == 0:  # eight times the weight, every eighth step
            volume = field(now) / peak
            loss = loss + 8 * smoothness * sum(volume.diff(dim=axis).abs().mean() for axis in range(3))
        adam.zero_grad()
        loss.backward()
        adam.step()
        decay.step()
    return api.Gaussians.from_rows(rows().detach().numpy().astype(float))


if __name__ == "__main__":
    scan = api.load_scan(sys.argv[1]) if len(sys.argv) > 1 else api.simulate("foot", size=24, detector=32, noise="tigre")
    cloud = train(scan, int(sys.argv[2]) if len(sys.argv) > 2 else 300)
    volume = api.voxelise(cloud, scan.grid)
    if scan.reference is not None:
        print(f"PSNR {api.compare(volume, scan.reference)['psnr_db']:.2f} dB from {cloud.count} Gaussians")
    api.save_volume("train_own.h5", api.Reconstruction(volume, scan.grid, cloud))
