"""SIRT written with the operators, on arrays of the device: python examples/own_sirt.py [scan.h5 [iterations]]"""

import sys

import numpy as np

from phyradgs_cl.api import Reconstruction, compare, load_scan, ray_operator, save_volume, simulate


def sirt(A, frames, iterations):
    """Iterates x ← x + C Aᵀ R (y − A x), R and C the inverse row and column sums of A, and returns x (z, y, x)."""
    y = A.to_device(frames)
    R = A.to_device(1 / np.maximum(A(np.ones(A.domain_shape)), 1e-3))
    C = A.to_device(1 / np.maximum(A.T(np.ones(A.range_shape)), 1e-3))
    x = A.to_device(np.zeros(A.domain_shape))
    for _ in range(iterations):
        x += C * A.T(R * (y - A(x)))
    return x.get()


if __name__ == "__main__":
    scan = load_scan(sys.argv[1]) if len(sys.argv) > 1 else simulate("foot", size=32, detector=48)
    iterations = int(sys.argv[2]) if len(sys.argv) > 2 else 50
    volume = sirt(ray_operator(scan, "per-row"), scan.projections, iterations)
    if scan.reference is not None:
        print(f"PSNR {compare(volume, scan.reference)['psnr_db']:.2f} dB")
    save_volume("own_sirt.h5", Reconstruction(volume, scan.grid))
