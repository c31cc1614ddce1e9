"""Fits of coarse scans: unknowns beside the volume are linear with a matching transpose, and levels and axes are found."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import ConeGeometry, PerRow, Protocol
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.fits.axis import axis_shift
from phyradgs_cl.reconstructors.fits.residuals import AugmentedOperator, FlatErrors, ViewParameters, fit
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.simulation import SimulationOptions, phantom_scene, simulate


@pytest.fixture(scope="module")
def scan(rt):
    geometry = ConeGeometry(5.0, 7.0, (6, 24), (0.17, 0.17))
    scene = phantom_scene(rt, "jaw", geometry, Grid.cube(12, 2.0), 12, "rows", 0)
    options = SimulationOptions(Protocol(views=12, exposure_deg=30.0, readout_ratio=0.0), time_samples=2)
    return simulate(scene.source, geometry, scene.grid, options)


@pytest.mark.parametrize("kind", ["flats", "views", "splines"])
def test_unknowns_beside_the_volume_have_a_transpose(rt, scan, kind) -> None:
    """⟨A x + B b, y⟩ = ⟨x, Aᵀ y⟩ + ⟨b, Bᵀ y⟩, and the parts of a vector are its unknowns in line integrals."""
    rng, operator = np.random.default_rng(0), System.of_scan(rt, scan, PerRow()).operator
    basis = rng.random((12, 4)) if kind == "splines" else np.eye(12)
    signals = rng.normal(size=(12, 2, 6, 24)).astype(np.float32)
    extra = FlatErrors.beside(operator) if kind == "flats" else ViewParameters(signals, basis)
    augmented = AugmentedOperator(operator, extra)
    x = rng.normal(size=augmented.volume_shape).astype(np.float32)
    y = rng.normal(size=augmented.frames_shape).astype(np.float32)
    forward, back = augmented.forward(x), augmented.adjoint(y)
    left, right = (float(np.vdot(*pair)) for pair in ((forward.astype(float), y), (x.astype(float), back)))
    assert abs(left - right) < 1e-5 * np.linalg.norm(forward) * np.linalg.norm(y)
    volume, values = augmented.parts(x)
    assert volume.shape == operator.volume_shape and values.size == extra.count
    np.testing.assert_allclose(forward, extra.add_to(operator.forward(volume), values))


def test_levels_of_frames_and_the_axis_are_fitted(rt, scan) -> None:
    steps = 0.05 * np.array([1, -1] * 6, np.float32)
    shaken = replace(scan, projections=scan.projections + steps[:, None, None])
    levels = fit(rt, shaken).level - fit(rt, scan).level
    np.testing.assert_allclose(levels - levels.mean(), steps, atol=0.01)
    shift = axis_shift(rt, scan)
    assert shift.is_found and abs(shift.pixels) < 0.2
