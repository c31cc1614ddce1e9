"""Scans with an effect planted, and without: the same noise in both."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, FrameSweeps, Protocol, Scan, pixel_centres
from phyradgs_cl.api import simulate
from phyradgs_cl.detector.effects import pixel_gains, tigre_noise
from phyradgs_cl.fields import Grid
from phyradgs_cl.phantoms import Ellipsoid, EllipsoidPhantom

Planted = Callable[..., Scan]
Noise = Callable[[np.ndarray, float, float, np.random.Generator], np.ndarray]
VIEWS = 180
# Attenuation per mm, centre x, y, z and half axes x, y, z in mm.
BODIES = {
    "head": [(0.3, 0, 0, 0, 0.75, 0.6, 0.8), (-0.1, 0, 0, 0, 0.68, 0.53, 0.72), (0.4, 0.3, 0.1, 0.1, 0.12, 0.2, 0.3)],
    "tube about the axis": [(0.5, 0, 0, 0, 0.7, 0.7, 9), (-0.5, 0, 0, 0, 0.64, 0.64, 9), (0.4, 0.2, 0.1, 0, 0.3, 0.25, 0.5)],
    "grains": [(0.5, 0.6 * np.cos(k), 0.6 * np.sin(k), 0.5 * np.sin(3 * k), 0.15, 0.15, 0.15) for k in range(7)],
    "skull": [(2.0, 0, 0, 0, 0.75, 0.6, 0.8), (-1.2, 0, 0, 0, 0.66, 0.51, 0.71), (1.2, 0.3, 0.1, 0.1, 0.12, 0.2, 0.3)],
}
CONE = (5.0, 7.0)  # source to axis and to panel in mm: a cone of 31°


@pytest.fixture(scope="session")
def planted(rt) -> Planted:
    """(option of ``simulate``=value...) → a fly-scan of the jaw, made once."""

    @cache
    def make(**effects: float) -> Scan:
        usual = {"size": 20, "detector": 30, "views": 36, "exposure_deg": 8.0, "peak": 3.0, "noise": "beer", "dose": 1e5}
        return simulate("jaw", device=rt, **{**usual, **effects})

    return make


@pytest.fixture(scope="session")
def closed_form() -> Planted:
    """(body, distances, arc in degrees, spread of gains, panel, photons, noise, views) → a stop-and-shoot scan."""

    @cache
    def make(
        name: str, distances: tuple[float, float] = CONE, arc_deg: float = 360.0, rings: float = 0.0,
        panel: int = 48, dose: float = 28_000, noise: Noise = tigre_noise, views: int = VIEWS,
    ) -> Scan:  # fmt: skip
        ellipsoids = [Ellipsoid((x, y, z), (a, b, c), per_mm) for per_mm, x, y, z, a, b, c in BODIES[name]]
        phantom = EllipsoidPhantom(tuple(ellipsoids), name)
        geometry = ConeGeometry(*distances, (panel, panel), 2.6 * distances[1] / distances[0] / panel)
        protocol, angle_rad = Protocol(views=views), np.deg2rad(np.arange(views) * arc_deg / views)
        poses = geometry.pose(angle_rad)
        frames = phantom.line_integrals(poses[:, None, None, :3], pixel_centres(poses, (panel, panel))).astype(np.float32)
        rng, grid = np.random.default_rng(5), Grid.cube(32, 2.0)
        frames = noise(frames, dose, 10.0, rng)
        if rings:
            frames = frames - np.log(pixel_gains((panel, panel), rings, rng)).astype(np.float32)
        start_s = protocol.frame_start_s()
        orbit = CircularOrbit(geometry, FrameSweeps(start_s, 1.0, angle_rad, angle_rad))
        reference = phantom.voxelise(grid, 1)
        return Scan(frames, geometry, orbit, protocol.shutter(), start_s, grid, is_fly=False, reference=reference)

    return make
