"""The detector: counts and line integrals, averages over an exposure, noise and other effects, estimates of them."""

from phyradgs_cl.detector.attenuation import (
    average,
    counts_to_attenuation,
    frames_to_attenuation,
    intensity_average,
)
from phyradgs_cl.detector.effects import (
    add_lag,
    add_scatter,
    add_sparks,
    beer_lambert_counts,
    beer_lambert_noise,
    drifting_light,
    lagged,
    pixel_gains,
    sample_counts,
    tigre_counts,
    tigre_noise,
    without_lag,
)
from phyradgs_cl.detector.noise_level import (
    clustered_share,
    find_saturation,
    noise_behind,
    noise_level,
    noise_rms,
    robust_deviation,
    transmission_weights,
)
from phyradgs_cl.detector.spectrum import Spectrum, tube_spectrum

__all__ = [
    "Spectrum", "add_lag", "add_scatter", "add_sparks", "average", "beer_lambert_counts", "beer_lambert_noise",
    "clustered_share", "counts_to_attenuation", "drifting_light", "find_saturation", "frames_to_attenuation",
    "intensity_average", "lagged", "noise_behind", "noise_level", "noise_rms", "pixel_gains", "robust_deviation",
    "sample_counts", "tigre_counts", "tigre_noise", "transmission_weights", "tube_spectrum", "without_lag"
]  # fmt: skip
