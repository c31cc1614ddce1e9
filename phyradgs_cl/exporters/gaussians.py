"""The Gaussians of a volume file as points with properties (.ply) or as NumPy arrays (.npz)."""

from pathlib import Path

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.io import Volume, written_beside

_PLY_NAMES = (
    *("x", "y", "z", "scale_0", "scale_1", "scale_2"), *("rot_0", "rot_1", "rot_2", "rot_3", "density")
)


def gaussians_of(volume: Volume, subject: str) -> dict[str, np.ndarray]:
    """Returns mean (G, 3) and scale (G, 3) in mm, quaternion (G, 4) w x y z, density (G,) in 1/mm; float32."""
    if volume.gaussians is None:
        remedy = "reconstruct with --method phyradgs or r2"
        raise InputError(f"{subject}:/entry/gaussians", "nothing there", "Gaussians", remedy)
    return vars(volume.gaussians)


def write_npz(path: Path, cloud: dict[str, np.ndarray]) -> None:
    """Writes four arrays by their names, without a pickle."""
    with written_beside(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **cloud)  # type: ignore[arg-type]


def write_ply(path: Path, cloud: dict[str, np.ndarray]) -> None:
    """Writes binary PLY with one vertex per Gaussian; comments in the header state the units."""
    columns = [cloud["mean"], cloud["scale"], cloud["quaternion"], cloud["density"][:, None]]
    rows = np.concatenate(columns, axis=1)
    properties = "".join(f"property float {name}\n" for name in _PLY_NAMES)
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        "comment radiative Gaussians: density * exp(-1/2 d^T (R diag(scale^2) R^T)^-1 d)\n"
        "comment x y z and scale in mm, rot quaternion w x y z, density in 1/mm; all linear\n"
        f"element vertex {len(rows)}\n{properties}end_header\n"
    )
    with written_beside(path) as temporary:
        temporary.write_bytes(head.encode("ascii") + np.ascontiguousarray(rows, "<f4").tobytes())
