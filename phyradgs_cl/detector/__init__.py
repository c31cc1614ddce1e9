"""The detector: counts and line integrals, averages over an exposure, noise, lag and other effects, and noise estimates."""

from phyradgs_cl.detector.attenuation import (
    Spectrum,
    average,
    counts_to_attenuation,
    intensity_average,
    tube_spectrum,
)
from phyradgs_cl.detector.effects import without_lag
from phyradgs_cl.detector.noise_level import noise_level, noise_rms, robust_deviation, transmission_weights

__all__ = [
    "Spectrum", "average", "counts_to_attenuation", "intensity_average", "noise_level", "noise_rms",
    "robust_deviation", "transmission_weights", "tube_spectrum", "without_lag",
]
