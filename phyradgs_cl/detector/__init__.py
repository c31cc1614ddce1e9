"""The detector: counts and line integrals, noise, and averaging over the exposure."""

from phyradgs_cl.detector.attenuation import counts_to_attenuation, frames_to_attenuation
from phyradgs_cl.detector.average import average, intensity_average
from phyradgs_cl.detector.effects import add_scatter, add_sparks, drifting_light, pixel_gains
from phyradgs_cl.detector.lag import add_lag, lagged, without_lag
from phyradgs_cl.detector.noise import (
    beer_lambert_counts,
    beer_lambert_noise,
    sample_counts,
    tigre_counts,
    tigre_noise,
)
from phyradgs_cl.detector.noise_level import noise_behind, noise_level, noise_rms, transmission_weights
from phyradgs_cl.detector.saturation import clustered_share, find_saturation
from phyradgs_cl.detector.spectrum import Spectrum, tube_spectrum

__all__ = [
    "Spectrum", "add_lag", "add_scatter", "add_sparks", "average", "beer_lambert_counts", "beer_lambert_noise",
    "clustered_share", "counts_to_attenuation", "drifting_light", "find_saturation", "frames_to_attenuation",
    "intensity_average", "lagged", "noise_behind", "noise_level", "noise_rms", "pixel_gains", "sample_counts",
    "tigre_counts", "tigre_noise", "transmission_weights", "tube_spectrum", "without_lag"
]  # fmt: skip
