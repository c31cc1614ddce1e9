"""Kramers' law against SpekPy's tungsten anode: half-value layers of aluminium, and the step that takes either."""

import numpy as np
import pytest

from phyradgs_cl.detector import Spectrum, tube_spectrum
from phyradgs_cl.detector.attenuation import _ALUMINIUM, _ALUMINIUM_G_PER_CM3, _at
from phyradgs_cl.prepare import water_polynomial


def half_value_mm(spectrum: Spectrum) -> float:
    """Aluminium that leaves half of the recorded signal."""
    depth_mm, per_mm = np.linspace(0, 30, 3001), _at(spectrum.energy_kev, _ALUMINIUM) * _ALUMINIUM_G_PER_CM3 / 10
    light = np.exp(-np.outer(depth_mm, per_mm)) @ spectrum.weight
    return float(np.interp(-0.5, -light, depth_mm))


@pytest.mark.parametrize("kvp", [60.0, 80.0, 100.0, 119.3, 150.0])
def test_half_value_layers_meet(kvp) -> None:
    """Kramers' law is softer: it knows neither the anode's own filter nor, from 70 kV on, its lines."""
    own, library = half_value_mm(tube_spectrum(kvp)), half_value_mm(tube_spectrum(kvp, anode_deg=12.0))
    assert 0.9 * library < own < library, (own, library)


def test_a_steeper_anode_and_a_thicker_filter_are_softer_and_harder() -> None:
    usual = half_value_mm(tube_spectrum(100.0, anode_deg=12.0))
    assert half_value_mm(tube_spectrum(100.0, anode_deg=25.0)) < usual < half_value_mm(tube_spectrum(100.0, 10.0, 12.0))
    assert water_polynomial(100.0, 5.0, 12.0) != water_polynomial(100.0)
