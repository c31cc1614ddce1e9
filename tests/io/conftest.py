"""Small scans for the file tests; every number differs from its neighbours, so that a mix-up shows."""

from collections.abc import Callable

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, FrameSweeps, Scan, Shutter
from phyradgs_cl.fields import Grid

FRAMES, ROWS, COLUMNS = 4, 3, 5
GEOMETRY = ConeGeometry(785.0, 1200.0, (ROWS, COLUMNS), (0.6, 0.5), (1.25, -2.5))
GRID = Grid((2, 3, 4), (1.5, 1.25, 1.0), (0.1, -0.2, 0.3))


@pytest.fixture
def make_scan() -> Callable[..., Scan]:
    """A factory of a 4-frame fly-scan (3 × 5 pixels); keywords replace fields of the Scan."""

    def make(**changes: object) -> Scan:
        rng, start_s = np.random.default_rng(7), np.array([0.5, 1.75, 3.0, 4.5])
        first_rad = np.deg2rad([10.0, 25.0, 40.0, 58.0])
        sweeps = FrameSweeps(start_s, 0.8, first_rad, first_rad + np.deg2rad([3.0, 4.0, 5.0, 6.0]))
        fields: dict[str, object] = {
            "projections": rng.uniform(0, 4, (FRAMES, ROWS, COLUMNS)).astype(np.float32),
            "geometry": GEOMETRY, "trajectory": CircularOrbit(GEOMETRY, sweeps),
            "shutter": Shutter(0.8, 0.3, "columns", -1), "frame_start_s": start_s, "grid": GRID,
            "detector_model": "intensity", "title": "a test scan",
        }
        return Scan(**(fields | changes))  # type: ignore[arg-type]

    return make
