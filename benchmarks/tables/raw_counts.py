"""Raw data of a flat panel: 16-bit counts, with flat and dark frames beside them."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.detector.effects import sample_counts

CALIBRATION_FRAMES = 10
_FULL_SCALE = 65_535


@dataclass(frozen=True)
class Panel:
    """Photon counts of an open pixel, electronic noise (standard deviation) and dark offset, all in counts.

    Flat fields correct two things: gains of pixels differ by ``gain_spread`` (relative standard deviation), and the beam
    falls off towards the corners by ``falloff``."""

    dose: float = 5e4
    electronic_noise: float = 10.0
    dark: float = 300.0
    gain_spread: float = 0.01
    falloff: float = 0.1


def measured_attenuation(
    line_integrals: np.ndarray, panel: Panel, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Returns line integrals (F, v, u) float32 from raw counts, flats and darks, and a mask of values that must not be used.

    line_integrals: (F, v, u), free of noise. panel: the detector's effects. rng: the only source of randomness."""
    frames, rows, columns = line_integrals.shape
    gain = _open_beam(panel, rows, columns, rng)
    flats = np.broadcast_to(gain, (CALIBRATION_FRAMES, rows, columns))
    light = [gain * np.exp(-line_integrals.astype(np.float64)), flats, np.zeros_like(flats)]
    counts = np.concatenate([_digitised(part, panel, rng) for part in light])
    image_key = np.repeat([0, 1, 2], [frames, CALIBRATION_FRAMES, CALIBRATION_FRAMES])
    return counts_to_attenuation(counts, image_key, "counts")


def _open_beam(panel: Panel, rows: int, columns: int, rng: np.random.Generator) -> np.ndarray:
    """Returns expected counts (v, u) above dark without an object."""
    v, u = np.linspace(-1, 1, rows)[:, None], np.linspace(-1, 1, columns)
    beam = 1 - panel.falloff * (u * u + v * v) / 2
    spread = np.clip(rng.normal(1.0, panel.gain_spread, (rows, columns)), 0.5, 1.5)
    return panel.dose * beam * spread


def _digitised(expected: np.ndarray, panel: Panel, rng: np.random.Generator) -> np.ndarray:
    counts = panel.dark + sample_counts(expected, panel.electronic_noise, rng)
    return np.clip(np.rint(counts), 0, _FULL_SCALE).astype(np.uint16)
