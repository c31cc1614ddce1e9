"""A tube's spectrum by Kramers' law: what voltage and filter do to it; another tube without its package is refused."""

import sys

import numpy as np
import pytest

from phyradgs_cl.detector import tube_spectrum
from phyradgs_cl.errors import InputError


def test_a_thicker_filter_hardens_less_and_bone_hardens_more_than_water() -> None:
    thick = np.array([3.0, 6.0])
    lost = [1 - tube_spectrum(120.0, filter_mm).hardened(thick) / thick for filter_mm in (1.0, 5.0, 12.0)]
    assert (lost[0] > lost[1]).all() and (lost[1] > lost[2]).all() and (lost[2] > 0).all()
    spectrum = tube_spectrum(120.0)
    assert (spectrum.hardened(np.zeros(2), thick) < spectrum.hardened(thick)).all()
    thin = spectrum.hardened(np.array([1e-4]), np.array([1e-4]))
    np.testing.assert_allclose(thin, 2e-4, rtol=1e-3)


def test_an_anode_asks_for_its_package(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "spekpy", None)
    with pytest.raises(InputError, match=r"phyradgs-cl\[spectrum\]"):
        tube_spectrum(120.0, anode_deg=12.0)
