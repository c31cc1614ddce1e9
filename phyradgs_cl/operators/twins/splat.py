"""Float64 twins of the projector of Gaussians, at rest or moving during a segment of time, and of their voxelisation.

At rest a Gaussian is integrated along each ray by the definition: ρ √(2π/a) exp(−½ (c − b²/a)) with the ray's direction n,
the precision A = Σ⁻¹, a = nᵀAn, b = nᵀA(μ−s), c = (μ−s)ᵀA(μ−s), density ρ, mean μ, source s. The integral is over the whole
line, for Gaussians in front of the source. The kernel works in detector coordinates and shares no formula with this
(docs/mathematics.md).

In motion, the definition is integrated over time numerically. In a segment a splat keeps the conic, amplitude and
perspective factor Q of the middle time, while its centre moves on the panel along a straight line at constant speed. The
length and direction of this line come from the mean μ projected by the two end poses. The centre at mid-time is the average
of the parabola through the projections at both ends and in the middle. The conic comes from the difference c − b bᵀ (see
``_Segment``), for which float32 has too few digits."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition.geometry import pixel_centres, transpose_pose
from phyradgs_cl.acquisition.time_cells import TimeCells


def precision_matrices(rows: np.ndarray) -> np.ndarray:
    """Returns the precision matrices Σ⁻¹ (G, 3, 3) of parameter rows (11, G)."""
    turn = Rotation.from_quat(rows[[7, 8, 9, 6]].T).as_matrix()
    return np.asarray(np.einsum("gij,gj,gkj->gik", turn, 1 / rows[3:6].T ** 2, turn))


def splat_image(
    rows: np.ndarray, pose: np.ndarray, detector_shape: tuple[int, int], cutoff_sigma: float = 0.0,
    affine: bool = False, is_parallel: bool = False,
) -> np.ndarray:
    """Returns the frame (nv, nu) of parameter rows (11, G) from one pose (12,), at rest."""
    image = np.zeros(detector_shape)
    one_image = _in_parallel if is_parallel else _affine if affine else _exact
    for row, precision in zip(rows.T, precision_matrices(rows), strict=True):
        image += one_image(row, precision, pose, detector_shape, cutoff_sigma)
    return image


def _exact(
    row: np.ndarray, precision: np.ndarray, pose: np.ndarray, detector_shape: tuple[int, int], cutoff_sigma: float
) -> np.ndarray:
    to_pixel, centre = pixel_centres(pose, detector_shape) - pose[:3], row[:3] - pose[:3]
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
        if abs(depth) <= reach:  # the ellipsoid crosses the plane through the source: kernels do not draw it
            return np.zeros_like(value)
        value = np.where(q <= cutoff_sigma**2, value, 0.0)
    return value


def _in_parallel(
    row: np.ndarray, precision: np.ndarray, pose: np.ndarray, detector_shape: tuple[int, int], cutoff_sigma: float
) -> np.ndarray:
    """Returns one Gaussian's line integrals (nv, nu) along parallel rays: density √(2π/a) exp(−q/2), where q is the
    smallest squared Mahalanobis distance along the ray."""
    offset = pixel_centres(pose, detector_shape) - row[:3]
    a = pose[:3] @ precision @ pose[:3]
    b = np.einsum("vui,ij,j->vu", offset, precision, pose[:3])
    q = np.einsum("vui,ij,vuj->vu", offset, precision, offset) - b**2 / a
    value = row[10] * np.sqrt(2 * np.pi / a) * np.exp(-q / 2)
    return np.where(q <= cutoff_sigma**2, value, 0.0) if cutoff_sigma > 0 else value


def _affine(
    row: np.ndarray, precision: np.ndarray, pose: np.ndarray, detector_shape: tuple[int, int],
    cutoff_sigma: float,
) -> np.ndarray:
    """Returns one Gaussian's frame (nv, nu) by R2-Gaussian's approximation: its covariance is projected by the Jacobian at
    the centre, and all rays have the amplitude of the ray through the centre."""
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
    rows: np.ndarray, table: TimeCells, detector_shape: tuple[int, int], cutoff_sigma: float = 0.0,
    affine: bool = False,
) -> np.ndarray:
    """Returns the frame (rows, columns) by Eq. 3 of the PhyRadGS paper: sums, over the cells, the cell's lines of a complete
    projection from the cell's pose, times the cell's weight."""
    frame = np.zeros(detector_shape)
    for cell in range(table.count):
        lines = slice(int(table.line_start[cell]), int(table.line_stop[cell]))
        like = detector_shape, cutoff_sigma, affine, table.is_parallel
        image = table.weight[cell] * splat_image(rows, table.pose[cell], *like)
        table.readout.frames(frame)[lines] += table.readout.frames(image)[lines]
    return frame


def voxel_field(
    rows: np.ndarray, z: np.ndarray, y: np.ndarray, x: np.ndarray, cutoff_sigma: float = 0.0
) -> np.ndarray:
    """Evaluates parameter rows (11, G) at voxel centres z, y, x, in the rows' unit of length. Returns (nz, ny, nx)."""
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).transpose(2, 1, 0, 3)
    volume = np.zeros(points.shape[:3])
    for row, precision in zip(rows.T, precision_matrices(rows), strict=True):
        offset = points - row[:3]
        q = np.einsum("zyxi,ij,zyxj->zyx", offset, precision, offset)
        value = row[10] * np.exp(-q / 2)
        volume += np.where(q <= cutoff_sigma**2, value, 0.0) if cutoff_sigma > 0 else value
    return volume


_PANELS = 6  # number of intervals of the numerical integral over time
_NODES = 12  # number of Gauss–Legendre nodes in each interval


@dataclass(frozen=True)
class _Segment:
    """One Gaussian in one segment of time, in pixels (u, v): average centre and path (2,), conic (2, 2), coefficients b (2,)
    and c (2, 2) of Q = 1 + 2 bᵀδ + δᵀcδ at the offset δ from the centre. amplitude: (peak value)/(length of the ray)."""

    centre: np.ndarray
    path: np.ndarray
    conic: np.ndarray
    b: np.ndarray
    c: np.ndarray
    amplitude: float


def moving_frame(
    rows: np.ndarray, table: TimeCells, detector_shape: tuple[int, int], cutoff_sigma: float = 0.0,
    affine: bool = False, cloud_at: Callable[[float], np.ndarray] | None = None,
) -> np.ndarray:
    """Returns the merged frame (nv, nu) of parameter rows (11, G) for moving cells, or for cells with a ``conic_pose``.

    With a ``conic_pose`` the splat rests in a cell: it has the shape that this pose gives, and the centre that the cell's
    own pose gives. cloud_at: for an object that moves, returns the rows at a time in s."""
    moved = table.conic_pose is not None
    poses, end_poses, line_times = _centre_segments(table) if moved else (table.pose, table.end_poses, table.line_times)
    assert end_poses is not None and line_times is not None
    by_column = table.axis == "columns"
    shape = detector_shape[::-1] if by_column else detector_shape
    turn = transpose_pose if by_column else np.asarray
    frame = np.zeros(shape)
    for cell, (pose, ends, times) in enumerate(zip(turn(poses), turn(end_poses), line_times, strict=True)):
        clouds = [rows] * 3
        if cloud_at is not None and table.end_times_s is not None:
            clouds = [cloud_at(time_s) for time_s in (table.time_s[cell], *table.end_times_s[cell])]
        means = np.stack([cloud[:3] for cloud in clouds[1:]]).transpose(2, 0, 1)  # means at both ends of the cell, (G, 2, 3)
        for row, precision, end_means in zip(clouds[0].T, precision_matrices(clouds[0]), means, strict=True):
            frame += _segment_image(
                row, precision, pose, ends, end_means, times, shape, cutoff_sigma, affine, table.is_parallel, moved
            )  # fmt: skip
    return frame.T if by_column else frame


def _centre_segments(table: TimeCells) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Describes cells with a ``conic_pose`` as moving ones: that pose for each cell (C, 12), the cell's own pose at both
    ends (C, 2, 12), and integration times (C, 3, lines) of length 0."""
    times = np.zeros((table.count, 3, table.lines))
    for cell, lines in enumerate(table.ranges):
        times[cell, 2, lines] = table.weight[cell]
    return np.broadcast_to(np.asarray(table.conic_pose), table.pose.shape), np.stack([table.pose, table.pose], 1), times


def seen_at(pose: np.ndarray, point: np.ndarray, is_parallel: bool = False) -> np.ndarray:
    """Returns (u, v, depth) of a world point, with u and v in pixels. In a parallel beam the depth is 1."""
    if is_parallel:
        p = np.linalg.solve(np.stack([pose[6:9], pose[9:12], pose[:3]], -1), point - pose[3:6])
        return np.array([p[0], p[1], 1.0])
    p = np.linalg.solve(np.stack([pose[6:9], pose[9:12], pose[3:6] - pose[:3]], -1), point - pose[:3])
    return np.array([p[0] / p[2], p[1] / p[2], p[2]])


def _segment(
    row: np.ndarray, precision: np.ndarray, pose: np.ndarray, ends: np.ndarray, end_means: np.ndarray, is_parallel: bool
) -> _Segment:
    u, v, z = seen_at(pose, row[:3], is_parallel)
    first, last = (seen_at(end, mean, is_parallel)[:2] for end, mean in zip(ends, end_means, strict=True))
    d0, steps = pose[:3] if is_parallel else (row[:3] - pose[:3]) / z, np.stack([pose[6:9], pose[9:12]], -1)
    alpha = d0 @ precision @ d0
    b, c = steps.T @ precision @ d0 / alpha, steps.T @ precision @ steps / alpha
    return _Segment(
        centre=(first + 4 * np.array([u, v]) + last) / 6, path=last - first, conic=z * z * alpha * (c - np.outer(b, b)), b=b,
        c=c, amplitude=float(row[10] * np.sqrt(2 * np.pi / alpha)),
    )


def _segment_image(
    row: np.ndarray, precision: np.ndarray, pose: np.ndarray, ends: np.ndarray, end_means: np.ndarray,
    times: np.ndarray, shape: tuple[int, int], cutoff_sigma: float, affine: bool,
    is_parallel: bool, moved: bool,
) -> np.ndarray:
    if min(seen_at(p, m, is_parallel)[2] for p, m in zip((pose, *ends), (row[:3], *end_means), strict=True)) <= 0:
        return np.zeros(shape)
    s = _segment(row, precision, pose, ends, end_means, is_parallel)
    if moved:
        s = replace(s, centre=seen_at(ends[0], row[:3], is_parallel)[:2])
    v, u = np.mgrid[: shape[0], : shape[1]]
    delta = np.stack([u, v], -1) - s.centre
    big_q = np.ones(shape) if affine or is_parallel else 1 + 2 * delta @ s.b + np.einsum("...i,ij,...j", delta, s.c, delta)
    ray = pose[3:6] - pose[:3] + u[..., None] * pose[6:9] + v[..., None] * pose[9:12]
    if affine:
        ray = (row[:3] - pose[:3]) / seen_at(pose, row[:3])[2]
    length = np.linalg.norm(pose[:3] if is_parallel else ray, axis=-1)
    share, weight = _nodes()
    at = times[0] + share[:, None] * times[1]  # (nodes, lines)
    mean = np.tensordot(weight, np.exp(-_exponent(s, delta, at[..., None], big_q) / 2), 1)
    value = times[2][:, None] * length * s.amplitude / np.sqrt(big_q) * mean
    return (
        np.where(_nearest(s, delta, times, big_q) <= cutoff_sigma**2, value, 0.0) if cutoff_sigma else value
    )


def _exponent(s: _Segment, delta: np.ndarray, at: np.ndarray, big_q: np.ndarray) -> np.ndarray:
    """Returns the exponent q (..., lines, width) when the centre has moved from its average place by ``at`` times the path.
    at: (..., lines, 1) or of the result's shape."""
    u, v = (delta[..., k] - at * s.path[k] for k in (0, 1))
    return np.asarray((s.conic[0, 0] * u**2 + 2 * s.conic[0, 1] * u * v + s.conic[1, 1] * v**2) / big_q)


def _nearest(s: _Segment, delta: np.ndarray, times: np.ndarray, big_q: np.ndarray) -> np.ndarray:
    """Returns the smallest value of ``_exponent`` (lines, width) during each line's exposure."""
    fast = s.path @ s.conic @ s.path
    best = delta @ s.conic @ s.path / fast if fast > 0 else np.zeros(delta.shape[:2])
    first, last = (times[0] - times[1])[:, None], (times[0] + times[1])[:, None]
    return _exponent(s, delta, np.clip(best, first, last), big_q)


@cache
def _nodes() -> tuple[np.ndarray, np.ndarray]:
    """Returns the nodes of a composite Gauss–Legendre rule on [−1, 1], and its weights, which sum to 1."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    middle = (np.arange(_PANELS) + 0.5) / _PANELS * 2 - 1
    return (middle[:, None] + node / _PANELS).ravel(), np.tile(weight / 2 / _PANELS, _PANELS)
