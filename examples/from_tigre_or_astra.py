"""From frames with a geometry of TIGRE or ASTRA to a volume and back, without either package."""

from types import SimpleNamespace

import numpy as np

from phyradgs_cl.api import Scan, compare, reconstruct, simulate

# stop-and-shoot frames (F, rows, columns); replace them by your own
made = simulate("jaw", size=32, detector=48, views=60, protocol="static")
frames, angles_rad = made.projections, made.trajectory.kinematics.angle_start_rad

# --- TIGRE: its geometry object, angles in radians, frames as Ax gives them
geo = SimpleNamespace(  # in your program: tigre.geometry(...)
    DSO=5.0,
    DSD=7.0,
    nDetector=np.array([48, 48]),  # v, u
    dDetector=np.array([4 / 48, 4 / 48]),  # mm
    offDetector=np.array([0.0, 0.0]),
    nVoxel=np.array([32, 32, 32]),  # z, y, x
    dVoxel=np.array([2 / 32, 2 / 32, 2 / 32]),
    offOrigin=np.array([0.0, 0.0, 0.0]),
)
by_tigre = reconstruct(Scan.from_tigre(geo, angles_rad, frames), "cgls", iterations=15)

# --- ASTRA: vectors of a cone_vec geometry in mm, frames in its order (rows, F, columns)
cos, sin, zero = np.cos(angles_rad), np.sin(angles_rad), np.zeros(60)
vectors = np.stack(
    [5 * cos, 5 * sin, zero]  # source
    + [-2 * cos, -2 * sin, zero]  # centre of the panel
    + [-sin * 4 / 48, cos * 4 / 48, zero]  # from column to column
    + [zero, zero, zero + 4 / 48],  # from row to row
    axis=1,
)
sinogram = frames.swapaxes(0, 1)
scan = Scan.from_astra(sinogram.swapaxes(0, 1), vectors, made.grid)
by_astra = reconstruct(scan, "cgls", iterations=15)

print("largest difference", abs(by_tigre.volume - by_astra.volume).max() / by_astra.volume.max())
print(f"{compare(by_astra.volume, made.reference)['psnr_db']:.1f} dB to the truth")

# --- and back: what astra.create_proj_geom("cone_vec", rows, columns, vectors) takes
assert np.allclose(scan.astra_vectors(), vectors)
print("volume for ASTRA (z, y, x):", by_astra.volume.shape)
