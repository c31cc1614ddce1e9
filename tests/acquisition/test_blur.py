"""The blur of a fly-scan, by hand and by the paths of points on the panel."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, ParallelGeometry, Scan, Shutter
from phyradgs_cl.acquisition.plausible import blur_facts, blur_line
from phyradgs_cl.acquisition.trajectory import CircularOrbit, ConstantSpeed
from phyradgs_cl.fields import Grid

COLUMNS, PITCH_MM = 200, 0.5
SPEED_DEG_PER_S = 10.0


def scan_of(offset_mm: float = 0.0, pulse_s: tuple[float, float] | None = None, **changes: object) -> Scan:
    """Ten frames of 4 × 200 pixels, 0.1 s each, at 10° per second: arcs of 1°."""
    geometry = ConeGeometry(1000.0, 1500.0, (4, COLUMNS), PITCH_MM, (0.0, offset_mm))
    orbit = CircularOrbit(geometry, ConstantSpeed(0.0, np.deg2rad(SPEED_DEG_PER_S)))
    shutter = Shutter(0.1, 0.05, pulse_s=pulse_s)
    start_s, grid = np.arange(10) * 0.2, Grid.cube(4, 10.0)
    fields = {"is_fly": True, **changes}
    return Scan(np.zeros((10, 4, COLUMNS), np.float32), geometry, orbit, shutter, start_s, grid, **fields)


def test_an_arc_of_a_degree_on_two_hundred_columns() -> None:
    """π/180 · 100 columns = 1.745; in a parallel beam as much, in a pulse its share."""
    assert blur_facts(scan_of()) == pytest.approx({"blur_at_rim_px": 1.7453, "blur_at_half_radius_px": 0.8727}, rel=1e-4)
    assert blur_line(scan_of()) == "blur at the rim: 1.7 px, at half radius 0.87 px"
    assert blur_facts(scan_of(is_fly=False)) == {} and blur_line(scan_of(is_fly=False)) == ""
    geometry = ParallelGeometry((4, COLUMNS), PITCH_MM)
    parallel = replace(scan_of(), geometry=geometry, trajectory=CircularOrbit(geometry, scan_of().trajectory.kinematics))
    assert blur_facts(parallel) == pytest.approx(blur_facts(scan_of()), rel=1e-9)
    # of the lines' windows 0 to 0.1 s, ..., 0.05 to 0.15 s the beam lights 20 ms: a fifth
    assert blur_facts(scan_of(pulse_s=(0.06, 0.02)))["blur_at_rim_px"] == pytest.approx(1.7453 / 5, rel=1e-4)


@pytest.mark.parametrize(("offset_mm", "radius_px"), [(2.5, 105), (-2.5, 105), (10.0, 120), (12.5, 125), (-60.0, 220)])
def test_a_panel_off_centre(offset_mm, radius_px) -> None:
    """The rim is where the farther side looks, as the default grid has it."""
    assert blur_facts(scan_of(offset_mm))["blur_at_rim_px"] == pytest.approx(radius_px * np.pi / 180, rel=1e-6)
