"""A scan as a physics of deepinv, whose solvers and priors reconstruct it: python examples/deepinv_physics.py [scan.h5]"""

import sys

import deepinv
import torch

import phyradgs_cl.api as api


def physics_of(scan, motion="per-row"):
    """Returns a linear physics of norm 1, from volumes (1, 1, nz, ny, nx) to projections (1, 1, F, rows, columns), and the
    norm in mm by which it is divided. Every detector row is at its own times, unless ``motion`` says otherwise."""
    operator = api.ray_operator(scan, motion)
    forward, back = api.as_torch(operator), api.as_torch(operator.T)

    def physics(norm):
        return deepinv.physics.LinearPhysics(
            A=lambda x, **_: forward(x[0, 0] / norm)[None, None],
            A_adjoint=lambda y, **_: back(y[0, 0] / norm)[None, None],
        )

    squared = physics(1.0).compute_norm(torch.ones(1, 1, *operator.domain_shape), verbose=False)
    norm = float(squared) ** 0.5
    return physics(norm), norm


def reconstruct(scan, motion="per-row", weight=1e-3, iterations=40):
    """Returns the volume (nz, ny, nx) in 1/mm: least squares with a prior of small values, by deepinv's FISTA."""
    physics, norm = physics_of(scan, motion)
    measured = torch.tensor(scan.projections)[None, None]
    solver = deepinv.optim.FISTA(
        data_fidelity=deepinv.optim.L2(), prior=deepinv.optim.L1Prior(), lambda_reg=weight * float(measured.max()),
        stepsize=1.0, max_iter=iterations, early_stop=False,
    )  # fmt: skip
    with torch.no_grad():
        return (solver(measured, physics)[0, 0] / norm).numpy()


if __name__ == "__main__":
    made = {"size": 24, "detector": 32, "views": 30}
    scan = api.load_scan(sys.argv[1]) if len(sys.argv) > 1 else api.simulate("jaw", **made)
    volume = reconstruct(scan)
    if scan.reference is not None:
        print(f"FISTA of deepinv: {api.compare(volume, scan.reference)['psnr_db']:.2f} dB")
    api.save_volume("deepinv.h5", api.Reconstruction(volume, scan.grid))
