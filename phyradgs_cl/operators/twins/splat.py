"""Float64 twin of the splat projector, by the definition of the line integral.

For each ray: ρ √(2π/a) exp(−½ (c − b²/a)) with direction n, a = nᵀAn, b = nᵀA(μ−s), c = (μ−s)ᵀA(μ−s):
the integral over the whole line, for Gaussians in front of the source. It shares no formula with the kernel,
which works in detector coordinates (docs/mathematics.md).
"""

import numpy as np
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition.geometry import pixel_centres
from phyradgs_cl.acquisition.time_cells import TimeCells


def precision_matrices(rows: np.ndarray) -> np.ndarray:
    """Σ⁻¹ (G, 3, 3) of parameter rows (11, G)."""
    turn = Rotation.from_quat(rows[[7, 8, 9, 6]].T).as_matrix()
    matrices: np.ndarray = np.einsum("gij,gj,gkj->gik", turn, 1 / rows[3:6].T ** 2, turn)
    return matrices


def splat_image(
    rows: np.ndarray,
    pose: np.ndarray,
    detector_shape: tuple[int, int],
    cutoff_sigma: float = 0.0,
    affine: bool = False,
) -> np.ndarray:
    """One static projection (nv, nu) of parameter rows (11, G) from one pose (12,)."""
    image = np.zeros(detector_shape)
    to_pixel = pixel_centres(pose, detector_shape) - pose[:3]
    for row, precision in zip(rows.T, precision_matrices(rows), strict=True):
        image += (
            _affine(row, precision, pose, detector_shape, cutoff_sigma)
            if affine
            else _exact(row, precision, pose, to_pixel, cutoff_sigma)
        )
    return image


def _exact(
    row: np.ndarray, precision: np.ndarray, pose: np.ndarray, to_pixel: np.ndarray, cutoff_sigma: float
) -> np.ndarray:
    centre = row[:3] - pose[:3]
    normal = np.cross(pose[6:9], pose[9:12])
    if normal @ centre * (normal @ to_pixel[0, 0]) <= 0:
        return np.zeros(to_pixel.shape[:2])
    kappa = centre @ precision @ centre
    a = np.einsum("vui,ij,vuj->vu", to_pixel, precision, to_pixel)
    b = np.einsum("vui,ij,j->vu", to_pixel, precision, centre)
    q = kappa - b**2 / a
    length = np.linalg.norm(to_pixel, axis=-1)
    value: np.ndarray = row[10] * np.sqrt(2 * np.pi / a) * length * np.exp(-q / 2)
    if cutoff_sigma > 0:
        depth = centre @ normal
        reach = cutoff_sigma * np.sqrt(normal @ np.linalg.inv(precision) @ normal)
        if abs(depth) <= reach:  # the ellipsoid crosses the plane of the source: it is not drawn
            return np.zeros_like(value)
        value = np.where(q <= cutoff_sigma**2, value, 0.0)
    return value


def _affine(
    row: np.ndarray,
    precision: np.ndarray,
    pose: np.ndarray,
    detector_shape: tuple[int, int],
    cutoff_sigma: float,
) -> np.ndarray:
    """R2-Gaussian's splat: covariance through the Jacobian at the centre, ray factor of the central ray."""
    source, eu, ev = pose[:3], pose[6:9], pose[9:12]
    centre = row[:3] - source
    inverse = np.linalg.inv(np.stack([eu, ev, pose[3:6] - source], -1))
    p = inverse @ centre
    if p[2] <= 0:
        return np.zeros(detector_shape)
    jacobian = (inverse[:2] - np.outer(p[:2] / p[2], inverse[2])) / p[2]
    conic = np.linalg.inv(jacobian @ np.linalg.inv(precision) @ jacobian.T)
    unit = centre / np.linalg.norm(centre)
    amplitude = row[10] * np.sqrt(2 * np.pi / (unit @ precision @ unit))
    du = np.arange(detector_shape[1])[None, :] - p[0] / p[2]
    dv = np.arange(detector_shape[0])[:, None] - p[1] / p[2]
    q = conic[0, 0] * du**2 + 2 * conic[0, 1] * du * dv + conic[1, 1] * dv**2
    value = amplitude * np.exp(-q / 2)
    return np.where(q <= cutoff_sigma**2, value, 0.0) if cutoff_sigma > 0 else value


def splat_frame(
    rows: np.ndarray,
    table: TimeCells,
    detector_shape: tuple[int, int],
    cutoff_sigma: float = 0.0,
    affine: bool = False,
) -> np.ndarray:
    """Eq. 3 unfused: render every cell's whole projection, then weigh, cut into strips and add up."""
    frame = np.zeros(detector_shape)
    for cell in range(table.count):
        lines = slice(int(table.line_start[cell]), int(table.line_stop[cell]))
        image = table.weight[cell] * splat_image(rows, table.pose[cell], detector_shape, cutoff_sigma, affine)
        if table.axis == "rows":
            frame[lines] += image[lines]
        else:
            frame[:, lines] += image[:, lines]
    return frame


def voxel_field(
    rows: np.ndarray, z: np.ndarray, y: np.ndarray, x: np.ndarray, cutoff_sigma: float = 0.0
) -> np.ndarray:
    """The field (nz, ny, nx) of parameter rows (11, G) at axes z, y, x, by direct evaluation."""
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).transpose(2, 1, 0, 3)
    volume = np.zeros(points.shape[:3])
    for row, precision in zip(rows.T, precision_matrices(rows), strict=True):
        offset = points - row[:3]
        q = np.einsum("zyxi,ij,zyxj->zyx", offset, precision, offset)
        value = row[10] * np.exp(-q / 2)
        volume += np.where(q <= cutoff_sigma**2, value, 0.0) if cutoff_sigma > 0 else value
    return volume
