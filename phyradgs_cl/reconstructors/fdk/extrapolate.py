"""Objects wider than the panel: what FDK's filter is told of the rays beyond it.

cosine: rows end in a quarter of a cosine (as Ohnesorge et al., Med. Phys. 27 (2000) 39, smooth theirs). cylinder: in the
chords of a cylinder that goes on from the row's last values and slope (Hsieh et al., Med. Phys. 31 (2004) 2385), of the
attenuation that the squares of what the row shows are a parabola for. Both only keep the cut from ringing into the volume:
what lies beyond the panel stays unknown. reprojected: ``beyond.py``.
"""

import numpy as np

WAYS = ("none", "cosine", "cylinder", "reprojected")
_SHARE = 0.5  # of the panel's columns, added at each side
_SLOPE_PIXELS = 5  # that the slope at the edge is measured over
_NOISE = 0.01  # of the largest line integral: an edge below it is air


def extrapolated(frames: np.ndarray, way: str) -> tuple[np.ndarray, int]:
    """Line integrals (F, v, u + 2 n) float32 continued beyond the first and last column, and n."""
    count = max(1, round(_SHARE * frames.shape[2]))
    beyond = np.arange(1, count + 1)
    least = _NOISE * float(np.percentile(frames, 99.9))
    curvature = _curvature(frames)
    sides = []
    for rows in (frames[..., ::-1], frames):  # each so that its end is the panel's
        pixels = min(_SLOPE_PIXELS, rows.shape[-1])
        end = rows[..., -pixels:].astype(np.float64)
        edge, slope = end.mean(-1, keepdims=True), (end[..., -1:] - end[..., :1]) / max(pixels - 1, 1)
        edge = np.where(edge > least, edge, 0)
        if way == "cosine":
            sides.append(edge * np.cos(np.pi / 2 * beyond / count))
        else:
            sides.append(_chords(edge, slope, curvature, beyond))
    wide = np.concatenate([sides[0][..., ::-1], frames, sides[1]], axis=-1)
    return wide.astype(np.float32), count


def _chords(edge: np.ndarray, slope: np.ndarray, curvature: np.ndarray, beyond: np.ndarray) -> np.ndarray:
    """Line integrals p (F, v, n): p² = edge² + 2 edge slope d − a d² at d pixels beyond, with a slope that does not rise,
    and an a that ends it within the n pixels."""
    falling, reach = np.minimum(slope, 0), beyond[-1]
    widest = (edge**2 + 2 * reach * edge * falling) / reach**2
    squares = edge**2 + 2 * edge * falling * beyond - np.maximum(curvature, widest) * beyond**2
    return np.sqrt(np.maximum(squares, 0))


def _curvature(frames: np.ndarray) -> np.ndarray:
    """(F, v, 1): of the parabola through the squares of each row, its downward curvature, in the median over the frames."""
    u = np.linspace(-1, 1, frames.shape[2])
    basis = np.stack([np.ones_like(u), u, u**2], axis=1)
    squares = np.maximum(frames, 0).astype(np.float64) ** 2
    down = -(squares @ np.linalg.pinv(basis)[2]) * (2 / max(frames.shape[2] - 1, 1)) ** 2
    return np.broadcast_to(np.maximum(np.median(down, axis=0), 0)[None, :, None], (*frames.shape[:2], 1))
