"""Balls of attenuation 1: their frames in closed form, and how dense a volume has them."""

import numpy as np

from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom


def balls(*places: tuple[tuple[float, float, float], float]) -> EllipsoidPhantom:
    """Balls of so many (centre, radius)."""
    return EllipsoidPhantom(tuple(Ellipsoid(centre, (radius,) * 3, 1.0) for centre, radius in places), "balls")


def frames_of(
    phantom: EllipsoidPhantom, pose: np.ndarray, shape: tuple[int, int], axis: str = "rows", is_parallel: bool = False
) -> np.ndarray:
    """Frames (F, rows, columns) float32 of poses (F, 12), or (F, lines, 12) of the lines along ``axis``."""
    pixels = pose[:, None, None] if pose.ndim == 2 else pose[:, :, None] if axis == "rows" else pose[:, None]
    rows, columns = np.arange(shape[0])[:, None, None], np.arange(shape[1])[:, None]
    targets = pixels[..., 3:6] + columns * pixels[..., 6:9] + rows * pixels[..., 9:12]
    source = np.broadcast_to(pixels[..., :3], targets.shape)
    ends = (targets - 200 * source, targets + 200 * source) if is_parallel else (source, targets)
    return phantom.line_integrals(*ends).astype(np.float32)


def levels(phantom: EllipsoidPhantom, volume: np.ndarray, grid: Grid, share: float = 0.7) -> np.ndarray:
    """The mean of a volume over the inner ``share`` of each ball's radius."""
    z, y, x = np.meshgrid(*grid.axes_mm(), indexing="ij")
    around = [(np.stack([x, y, z], -1) - ball.centre_mm, ball.semi_axes_mm[0]) for ball in phantom.ellipsoids]
    return np.array([volume[np.linalg.norm(away, axis=-1) < share * radius].mean() for away, radius in around])
