"""The spectrum of a tube, and line integrals of soft tissue and bone in it.

The spectrum follows Kramers' law (Phil. Mag. 46 (1923) 836), or SpekPy's tungsten anode (Poludniowski et al., Med. Phys. 48
(2021) 3630), behind aluminium. Attenuation is interpolated in the logarithms of NIST's tables (Hubbell and Seltzer, NISTIR
5632). Both materials attenuate as stated in the thinnest layer; thicker layers attenuate less per length."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl import checks

Array = NDArray[np.floating]
_ENERGY_KEV = np.array([15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0, 150.0])
# Mass attenuation in cm²/g: water, cortical bone (ICRU-44) and aluminium
_WATER = np.array([1.673, 0.8096, 0.3756, 0.2683, 0.2269, 0.2059, 0.1837, 0.1707, 0.1505])
_BONE = np.array([9.032, 4.001, 1.331, 0.6655, 0.4242, 0.3148, 0.2229, 0.1855, 0.1480])
_ALUMINIUM = np.array([7.955, 3.441, 1.128, 0.5685, 0.3681, 0.2778, 0.2018, 0.1704, 0.1378])
_ALUMINIUM_G_PER_CM3 = 2.699
_STEP_KEV = 2.0  # of SpekPy's energies: finer steps change a half-value layer by less than a thousandth
LOWEST_KVP, HIGHEST_KVP = 30.0, 150.0
FILTER_MM = 5.0


@dataclass(frozen=True, eq=False)
class Spectrum:
    """energy_kev (E,). weight (E,): fraction of the signal recorded at each energy, sum 1. soft, bone (E,): attenuation
    there relative to its mean."""

    energy_kev: Array
    weight: Array
    soft: Array
    bone: Array

    def hardened(self, soft: Array, bone: Array | float = 0.0) -> Array:
        """Returns measured line integrals for those of the two materials (any shape) in the thin limit."""
        soft, energies = np.asarray(soft, np.float64), zip(self.weight, self.soft, self.bone, strict=True)
        # Energy by energy, as ``intensity_average`` would hold all of them in memory.
        return -np.log(sum(w * np.exp(-(s * soft + b * np.asarray(bone))) for w, s, b in energies))


def tube_spectrum(kvp: float, filter_mm: float = FILTER_MM, anode_deg: float = 0.0) -> Spectrum:
    """Returns the spectrum of a tube at ``kvp`` kV behind ``filter_mm`` of aluminium, for a panel that integrates energy.

    It is SpekPy's for a tungsten anode of ``anode_deg``, and follows Kramers' law at 0. Raises InputError for an anode
    without the package spekpy."""
    energy_kev, photons = _tungsten(kvp, anode_deg) if anode_deg else _kramers(kvp)
    light = photons * energy_kev * np.exp(-_at(energy_kev, _ALUMINIUM) * _ALUMINIUM_G_PER_CM3 * filter_mm / 10)
    weight = light / light.sum()
    soft, bone = _at(energy_kev, _WATER), _at(energy_kev, _BONE)
    return Spectrum(energy_kev, weight, soft / (weight @ soft), bone / (weight @ bone))


def _kramers(kvp: float) -> tuple[Array, Array]:
    """Returns energies (E,) in keV and the photons of each, without a filter."""
    energy_kev = np.linspace(_ENERGY_KEV[0], kvp, 40, endpoint=False)
    return energy_kev, (kvp - energy_kev) / energy_kev


def _tungsten(kvp: float, anode_deg: float) -> tuple[Array, Array]:
    """Returns the same with SpekPy, characteristic lines included."""
    spekpy = checks.package("spekpy", "the package that hardening.anode_deg asks", "phyradgs-cl[spectrum]")
    energy_kev, photons = spekpy.Spek(kvp=kvp, th=anode_deg, dk=_STEP_KEV).get_spectrum(diff=False)
    tabulated = energy_kev >= _ENERGY_KEV[0]
    return energy_kev[tabulated], photons[tabulated]


def _at(energy_kev: Array, table: Array) -> Array:
    return np.exp(np.interp(np.log(energy_kev), np.log(_ENERGY_KEV), np.log(table)))
