"""Float64 twin of the splat that moves through a segment: its definition, by quadrature in time.

In a segment a splat keeps the conic, amplitude and perspective factor Q of its mid-time while its centre runs along a
straight path at constant speed. The path's ends are those of the mean seen from the segment's two end poses, its middle
is the mean of the parabola through both ends and the middle. Conic and Q come from the plain difference C − b bᵀ, which
float64 can afford and the kernel cannot (docs/mathematics.md).
"""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.acquisition.geometry import transpose_pose
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.operators.twins.splat import precision_matrices

_PANELS, _NODES = 6, 12


@dataclass(frozen=True)
class _Segment:
    """One Gaussian in one segment: all vectors are (u, v) in pixels; ``length`` (lines, width) or a number."""

    centre: np.ndarray
    path: np.ndarray
    conic: np.ndarray
    b: np.ndarray
    c: np.ndarray
    amplitude: float


def moving_frame(
    rows: np.ndarray,
    table: TimeCells,
    detector_shape: tuple[int, int],
    cutoff_sigma: float = 0.0,
    affine: bool = False,
    pixel_variance: float = 0.0,
) -> np.ndarray:
    """The merged frame (nv, nu) of parameter rows (11, G) over cells with motion.

    ``pixel_variance`` (pixels²) is added to the covariance of every splat on the detector, mass kept.
    """
    assert table.end_poses is not None and table.line_times is not None
    by_column = table.axis == "columns"
    shape = detector_shape[::-1] if by_column else detector_shape
    turn = transpose_pose if by_column else np.asarray
    frame = np.zeros(shape)
    for pose, ends, times in zip(turn(table.pose), turn(table.end_poses), table.line_times, strict=True):
        for row, precision in zip(rows.T, precision_matrices(rows), strict=True):
            frame += _segment_image(
                row, precision, pose, ends, times, shape, cutoff_sigma, affine, pixel_variance
            )
    return frame.T if by_column else frame


def seen_at(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(u, v, depth) of a world point, u and v in pixels."""
    p = np.linalg.solve(np.stack([pose[6:9], pose[9:12], pose[3:6] - pose[:3]], -1), point - pose[:3])
    return np.array([p[0] / p[2], p[1] / p[2], p[2]])


def _segment(
    row: np.ndarray, precision: np.ndarray, pose: np.ndarray, ends: np.ndarray, pixel_variance: float
) -> _Segment:
    u, v, z = seen_at(pose, row[:3])
    first, last = (seen_at(end, row[:3])[:2] for end in ends)
    d0, steps = (row[:3] - pose[:3]) / z, np.stack([pose[6:9], pose[9:12]], -1)
    alpha = d0 @ precision @ d0
    b, c = steps.T @ precision @ d0 / alpha, steps.T @ precision @ steps / alpha
    sharp = z * z * alpha * (c - np.outer(b, b))
    conic = np.linalg.inv(np.linalg.inv(sharp) + pixel_variance * np.eye(2))
    mass_kept = np.sqrt(np.linalg.det(conic) / np.linalg.det(sharp))
    return _Segment(
        centre=(first + 4 * np.array([u, v]) + last) / 6,
        path=last - first,
        conic=conic,
        b=b,
        c=np.outer(b, b) + conic / (z * z * alpha),
        amplitude=float(mass_kept * row[10] * np.sqrt(2 * np.pi / alpha)),
    )


def _segment_image(
    row: np.ndarray,
    precision: np.ndarray,
    pose: np.ndarray,
    ends: np.ndarray,
    times: np.ndarray,
    shape: tuple[int, int],
    cutoff_sigma: float,
    affine: bool,
    pixel_variance: float,
) -> np.ndarray:
    if min(seen_at(p, row[:3])[2] for p in (pose, *ends)) <= 0:
        return np.zeros(shape)
    s = _segment(row, precision, pose, ends, pixel_variance)
    v, u = np.mgrid[: shape[0], : shape[1]]
    delta = np.stack([u, v], -1) - s.centre
    big_q = np.ones(shape) if affine else 1 + 2 * delta @ s.b + np.einsum("...i,ij,...j", delta, s.c, delta)
    ray = pose[3:6] - pose[:3] + u[..., None] * pose[6:9] + v[..., None] * pose[9:12]
    mid = seen_at(pose, row[:3])
    length = np.linalg.norm((row[:3] - pose[:3]) / mid[2] if affine else ray, axis=-1)
    mean = np.zeros(shape)
    for share, weight in zip(*_nodes(), strict=True):
        at = times[0] + share * times[1]
        mean += weight * np.exp(-_exponent(s, delta, at[:, None], big_q) / 2)
    value = times[2][:, None] * length * s.amplitude / np.sqrt(big_q) * mean
    return (
        np.where(_nearest(s, delta, times, big_q) <= cutoff_sigma**2, value, 0.0) if cutoff_sigma else value
    )


def _exponent(s: _Segment, delta: np.ndarray, at: np.ndarray, big_q: np.ndarray) -> np.ndarray:
    """q (lines, width) when the centre has moved for times ``at`` (lines, 1 or width)."""
    moved = delta - at[..., None] * s.path
    q: np.ndarray = np.einsum("...i,ij,...j", moved, s.conic, moved) / big_q
    return q


def _nearest(s: _Segment, delta: np.ndarray, times: np.ndarray, big_q: np.ndarray) -> np.ndarray:
    """The smallest q within each line's window."""
    fast = s.path @ s.conic @ s.path
    best = delta @ s.conic @ s.path / fast if fast > 0 else np.zeros(delta.shape[:2])
    first, last = (times[0] - times[1])[:, None], (times[0] + times[1])[:, None]
    return _exponent(s, delta, np.clip(best, first, last), big_q)


def _nodes() -> tuple[np.ndarray, np.ndarray]:
    """Composite Gauss–Legendre nodes on [−1, 1] and weights that sum to 1."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    middle = (np.arange(_PANELS) + 0.5) / _PANELS * 2 - 1
    return (middle[:, None] + node / _PANELS).ravel(), np.tile(weight / 2 / _PANELS, _PANELS)
