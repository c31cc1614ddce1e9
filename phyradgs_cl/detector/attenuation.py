"""Converts counts to line integrals, averages line integrals over an exposure, and models the spectrum of a tube.

The spectrum behind an aluminium filter follows Kramers' law (Phil. Mag. 46 (1923) 836), or SpekPy's tungsten anode
(Poludniowski et al., Med. Phys. 48 (2021) 3630). Attenuation is interpolated in the logarithms of NIST's tables (Hubbell and
Seltzer, NISTIR 5632). Thin layers keep their line integrals; thick ones attenuate less per length: the beam hardens."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError

PROJECTION, FLAT, DARK, INVALID = 0, 1, 2, 3  # the codes of NXtomo's image_key
QUANTITIES = ("attenuation", "transmission", "counts")
# The logarithm is taken of this transmission at least: 16-bit panels resolve no less. Pixels at or below it are masked.
TRANSMISSION_FLOOR = 1e-6
_LARGEST = float(np.finfo(np.float32).max)  # by default every finite float32 is a usable line integral
_BLOCK_PIXELS = 1 << 18  # about as many pixels are converted at a time: a float64 copy of a whole scan needs much memory
Array = NDArray[np.floating]
_ENERGY_KEV = np.array([15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0, 150.0])
# Mass attenuation coefficients at these energies, in cm²/g, of water, cortical bone (ICRU-44) and aluminium.
_WATER = np.array([1.673, 0.8096, 0.3756, 0.2683, 0.2269, 0.2059, 0.1837, 0.1707, 0.1505])
_BONE = np.array([9.032, 4.001, 1.331, 0.6655, 0.4242, 0.3148, 0.2229, 0.1855, 0.1480])
_ALUMINIUM = np.array([7.955, 3.441, 1.128, 0.5685, 0.3681, 0.2778, 0.2018, 0.1704, 0.1378])
_ALUMINIUM_G_PER_CM3 = 2.699
_STEP_KEV = 2.0  # step of SpekPy's energies: finer steps change a half-value layer by less than a thousandth
LOWEST_KVP, HIGHEST_KVP = 30.0, 150.0  # range of tube voltages in kV that the tables above cover
FILTER_MM = 5.0


def counts_to_attenuation(
    data: ArrayLike, image_key: ArrayLike, quantity: str, at: ArrayLike | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Converts the projections of a scan, data (F, v, u), to line integrals (P, v, u) float32, always finite.

    quantity: "counts": the transmission is (I − dark) / (flat − dark), with the mean dark (0 without darks). "transmission":
    data are the transmission. "attenuation": data are line integrals already. image_key (F,): 0 projection, 1 flat, 2 dark,
    3 invalid. at (F,): when frames were taken, in any unit. Flats without a projection between them are averaged, and these
    means interpolated linearly in ``at``; None takes the mean of all flats.

    The second result (P, v, u) is True where a value must not be used: it is not finite, the flat is not brighter than the
    dark, or the transmission is at most ``TRANSMISSION_FLOOR``. Raises InputError for counts without a flat."""
    frames, key = np.asarray(data), np.asarray(image_key)
    numbers = np.flatnonzero(key == PROJECTION)
    flats, darks = frames[key == FLAT], frames[key == DARK]
    if at is None or quantity != "counts" or len(flats) == 0:
        return frames_to_attenuation(frames, quantity, flats, darks, numbers=numbers)
    when, flats_at = np.asarray(at)[numbers], np.asarray(at)[key == FLAT]
    times = flats_by_time(flats_at, when)
    means = np.stack([flats[group].mean(axis=0, dtype=np.float64) for group in times])
    place = np.interp(when, [flats_at[group].mean() for group in times], np.arange(len(times)))
    return frames_to_attenuation(frames, quantity, means, darks, place=place, numbers=numbers)


def frames_to_attenuation(
    frames: NDArray[np.generic], quantity: str, flats: NDArray[np.generic] | None, darks: NDArray[np.generic] | None,
    largest: float = _LARGEST, place: NDArray[np.floating] | None = None, numbers: NDArray[np.intp] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Converts projections (P, v, u) to line integrals as ``counts_to_attenuation`` does. flats, darks: (n, v, u), or None.

    With the quantity "attenuation", |values| above ``largest`` are marked as unusable too. place (P,): each projection's
    place among the flats, which are interpolated there: 0.5 is halfway from the first flat to the second; None takes the
    flats' mean. numbers (P,): indices of the projections in ``frames``; None: all."""
    panel, projections = frames.shape[1:], range(len(frames)) if numbers is None else numbers
    result = np.empty((len(projections), *panel), dtype=np.float32)
    unusable = np.empty(result.shape, dtype=bool)
    rows = max(1, _BLOCK_PIXELS // max(1, panel[1]))
    with np.errstate(over="ignore", invalid="ignore"):  # overflowing values are marked as unusable
        dark, gain = np.broadcast_to(0.0, panel), np.broadcast_to(1.0, panel)
        if quantity == "counts":
            if flats is None or len(flats) == 0:
                remedy = "add flat frames, or store transmission or attenuation"
                raise InputError("image_key", "no flat (key 1) among counts", "at least one flat frame", remedy)
            dark = mean_dark(darks, panel)
            gain = flats.mean(axis=0, dtype=np.float64) - dark
        for i, frame in enumerate(projections):
            if place is not None and flats is not None and len(flats) > 1 and quantity == "counts":
                first = min(int(place[i]), len(flats) - 2)
                gain = flats[first] + (place[i] - first) * (flats[first + 1] - flats[first]) - dark
            for start in range(0, panel[0], rows):
                part = slice(start, start + rows)
                values = frames[frame, part].astype(np.float64)
                if quantity == "attenuation":
                    bad = ~(np.abs(values) <= largest)  # NaN is bad too: every comparison with it is false
                    result[i, part], unusable[i, part] = np.where(bad, 0.0, values), bad
                else:
                    result[i, part], unusable[i, part] = minus_log(values - dark[part], gain[part])
    return result, unusable


def flats_by_time(flats_at: NDArray[np.generic], at: NDArray[np.generic]) -> list[NDArray[np.intp]]:
    """Returns the indices of flats, those of one time together: flats without a projection between them. flats_at (n,), at
    (P,): when flats and projections were taken, in one unit."""
    before = np.searchsorted(np.sort(at), flats_at)
    return [np.flatnonzero(before == count) for count in np.unique(before)]


def mean_dark(darks: NDArray[np.generic] | None, panel: tuple[int, ...]) -> NDArray[np.float64]:
    """Returns the mean (v, u) of dark frames (n, v, u), or zeros without any. A NaN spoils only its own pixel."""
    if darks is None or len(darks) == 0:
        return np.zeros(panel)
    return np.asarray(darks.mean(axis=0, dtype=np.float64))


def minus_log(signal: NDArray[np.float64], gain: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Returns −ln(signal / gain) for arrays of one shape, and a mask that is True where the result must not be used.

    The result is 0 where signal or gain is not finite, and where the gain is 0 or less. Transmissions below
    ``TRANSMISSION_FLOOR`` count as this floor."""
    live = np.isfinite(signal) & np.isfinite(gain) & (gain > 0)
    transmission = np.divide(signal, gain, out=np.zeros_like(signal), where=live)
    p = -np.log(np.maximum(transmission, TRANSMISSION_FLOOR))
    unusable = ~live | (transmission <= TRANSMISSION_FLOOR) | ~np.isfinite(transmission)
    return np.where(live & np.isfinite(p), p, 0.0), unusable


def average(p: ArrayLike, weight: ArrayLike, model: str) -> NDArray[np.float64]:
    """Averages line integrals p (S, ...) over S moments of an exposure. Returns (...) float64.

    The model "log" takes their weighted mean (PhyRadGS, Eq. 1). The model "intensity" adds photons as a detector does:
    −ln Σ w exp(−p), without overflow at any p. weight (S,): the moments' fractions w of the exposure, at least 0, sum 1."""
    values, weights = np.asarray(p, dtype=np.float64), np.asarray(weight, dtype=np.float64)
    return np.tensordot(weights, values, axes=1) if model == "log" else intensity_average(values, weights)[0]


def intensity_average(p: Iterable[np.ndarray], weights: Iterable[np.ndarray]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns −ln Σ w exp(−p) over S moments, and its derivative by each moment's p: w exp(−p) / Σ w exp(−p).

    p: S arrays of line integrals; the results have their precision and cannot overflow. weights: S numbers or arrays w that
    broadcast, with sum 1. Where all weights are 0, both results are 0."""
    pairs = list(zip(p, weights, strict=True))
    least = np.minimum.reduce([np.where(w > 0, q, np.inf) for q, w in pairs])  # line integral of the brightest moment
    least = np.where(np.isfinite(least), least, 0)
    intensities = [w * np.exp(np.where(w > 0, least - q, 0)) for q, w in pairs]
    total = np.sum(intensities, axis=0)
    inverse = np.divide(1, total, out=np.zeros_like(total), where=total > 0)
    return least - np.log(np.where(total > 0, total, 1)), [part * inverse for part in intensities]


@dataclass(frozen=True, eq=False)
class Spectrum:
    """A beam's spectrum at energies energy_kev (E,). weight (E,): each energy's fraction of the recorded signal, sum 1.

    soft, bone (E,): attenuation coefficients of soft tissue and bone, divided by their means weighted by ``weight``."""

    energy_kev: Array
    weight: Array
    soft: Array
    bone: Array

    def hardened(self, soft: Array, bone: Array | float = 0.0) -> Array:
        """Returns the line integrals (any shape) that this beam measures. soft, bone: both materials' parts of the line
        integrals without hardening."""
        soft, energies = np.asarray(soft, np.float64), zip(self.weight, self.soft, self.bone, strict=True)
        # The sum runs over one energy at a time: ``intensity_average`` would hold arrays of all energies in memory.
        return -np.log(sum(w * np.exp(-(s * soft + b * np.asarray(bone))) for w, s, b in energies))


def tube_spectrum(kvp: float, filter_mm: float = FILTER_MM, anode_deg: float = 0.0) -> Spectrum:
    """Returns the spectrum of a tube at ``kvp`` kV behind ``filter_mm`` of aluminium, for a panel that integrates energy.

    The spectrum is SpekPy's for a tungsten anode at the angle ``anode_deg``; for 0 it follows Kramers' law. Raises
    InputError for an ``anode_deg`` other than 0 if the package spekpy is missing."""
    if anode_deg:
        spekpy = checks.package("spekpy", "the package that hardening.anode_deg asks", "phyradgs-cl[spectrum]")
        energy_kev, photons = spekpy.Spek(kvp=kvp, th=anode_deg, dk=_STEP_KEV).get_spectrum(diff=False)
        energy_kev, photons = (values[energy_kev >= _ENERGY_KEV[0]] for values in (energy_kev, photons))
    else:
        energy_kev = np.linspace(_ENERGY_KEV[0], kvp, 40, endpoint=False)
        photons = (kvp - energy_kev) / energy_kev
    light = photons * energy_kev * np.exp(-_at(energy_kev, _ALUMINIUM) * _ALUMINIUM_G_PER_CM3 * filter_mm / 10)
    weight = light / light.sum()
    soft, bone = _at(energy_kev, _WATER), _at(energy_kev, _BONE)
    return Spectrum(energy_kev, weight, soft / (weight @ soft), bone / (weight @ bone))


def _at(energy_kev: Array, table: Array) -> Array:
    return np.exp(np.interp(np.log(energy_kev), np.log(_ENERGY_KEV), np.log(table)))
