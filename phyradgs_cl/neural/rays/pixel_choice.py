"""Which pixels per step looks at: scattered over the frame, or in windows too.

Windows beside scattered pixels: the masked local–global sampling of SAX-NeRF (Cai et al., CVPR 2024).
"""

import numpy as np


def scattered_pixels(usable: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` pixels (R, 2) row, column of those that are usable (rows, columns) bool, each at most once."""
    where = np.flatnonzero(usable)
    chosen = rng.choice(where, min(count, where.size), replace=False, shuffle=False)
    return np.stack(np.unravel_index(chosen, usable.shape), -1)


def windows_and_scattered_pixels(
    usable: np.ndarray, count: int, windows: int, edge: int, rng: np.random.Generator
) -> np.ndarray:
    """The pixels of ``windows`` windows of ``edge``² usable pixels, and ``count`` scattered ones outside them; (R, 2).

    Windows tile the frame; where fewer of them are usable throughout, there are fewer.
    """
    down, across = (n // edge for n in usable.shape)
    tiles = usable[: down * edge, : across * edge].reshape(down, edge, across, edge).all(axis=(1, 3))
    whole = np.flatnonzero(tiles)
    chosen = rng.choice(whole, min(windows, whole.size), replace=False, shuffle=False)
    corner = np.stack(np.unravel_index(chosen, tiles.shape), -1) * edge
    inside = np.stack(np.meshgrid(np.arange(edge), np.arange(edge), indexing="ij"), -1).reshape(-1, 2)
    local = (corner[:, None] + inside).reshape(-1, 2)
    rest = usable.copy()
    rest[local[:, 0], local[:, 1]] = False
    return np.concatenate([local, scattered_pixels(rest, count, rng)])


def chosen_times(pixels: int, times: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` of the ``times`` of every pixel (R, count), each at most once and all equally likely."""
    if count >= times:
        return np.broadcast_to(np.arange(times), (pixels, times))
    return np.argsort(rng.random((pixels, times)), axis=1)[:, :count]
