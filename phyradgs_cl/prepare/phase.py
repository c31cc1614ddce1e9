"""Retrieves phase from one distance: removes the bright and dark edges that free propagation adds to line integrals.

Paganin, Mayo, Gureyev, Miller and Wilkins, J. Microsc. 206 (2002) 33. The object has one material (refractive index 1 − δ +
iβ) of thickness T. At the distance d and the wavelength λ, the transport-of-intensity equation gives the transmission
exp(−p) as (1 − d δ/μ ∇²) exp(−μT), with μ = 4πβ/λ. The inverse divides by 1 + π λ d (δ/β) f² at the frequency f, in 1/mm.

The filter is linear in intensity, so it holds for the average over an exposure. A rolling shutter reads later rows when the
object has turned further. This is ignored: the filter mixes rows only a few pixels apart."""

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import ParallelGeometry, Scan
from phyradgs_cl.detector.attenuation import TRANSMISSION_FLOOR
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.step import Facts, MakeModel, StepOptions, unmasked_frames

WAVELENGTH_MM_KEV = 1.239841984e-6  # wavelength in mm times energy in keV: Planck's constant times the speed of light
_REACHES = 8  # frames are padded by this many decay lengths of the filter: only exp(−8) of an edge wraps around


@dataclass(frozen=True)
class PhaseOptions(StepOptions, step="phase"):
    """Options of the step ``phase``. energy_kev: the beam's energy. distance_mm: the distance from object to panel; None
    takes the distance from axis to panel, for a cone beam only. delta_beta: δ/β of the object's material. delta, beta: δ and
    β themselves, in place of their ratio. Raises InputError for values out of range or in contradiction."""

    energy_kev: float | None = checks.ranged(None, 1, 1000)
    distance_mm: float | None = checks.ranged(None, 0, 1e6)
    delta_beta: float | None = checks.ranged(None, 0, 1e6)
    delta: float | None = checks.ranged(None, 0, 1)
    beta: float | None = checks.ranged(None, 0, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        both = [name for name in ("beta", "delta") if getattr(self, name) is not None]
        if self.delta_beta is not None and both:
            raise InputError("phase.delta_beta", f"given with phase.{both[0]}", "δ/β, or δ and β", "leave one out")
        if self.beta == 0:
            raise InputError("phase.beta", "0", "a number above 0", "an object without absorption hides its thickness")

    def stated(self) -> tuple[float, float]:
        """Returns energy in keV and δ/β. Raises one InputError for all missing values, which no scan file states."""
        ratio = self.delta / self.beta if self.delta is not None and self.beta else self.delta_beta
        if self.energy_kev is not None and ratio is not None:
            return self.energy_kev, ratio
        material = ("delta_beta",) if self.delta is None and self.beta is None else ("delta", "beta")
        missing = [f"phase.{name}" for name in ("energy_kev", *material) if getattr(self, name) is None]
        expected = "the beam's energy in keV, and δ/β of the object (delta_beta, or delta and beta)"
        remedy = "say " + ", ".join(f"--set {name}=NUMBER" for name in missing)
        remedy += "; a parallel beam needs phase.distance_mm too" if self.distance_mm is None else ""
        raise InputError(", ".join(missing), "nothing", expected, remedy)


def retrieve_phase(
    frames: np.ndarray, pixel_mm: tuple[float, float], distance_mm: float, energy_kev: float, delta_beta: float
) -> np.ndarray:
    """Returns line integrals of attenuation alone, float32, from line integrals (F, v, u) after free propagation.

    pixel_mm (v, u), distance_mm: for a parallel beam. A cone beam with the magnification M has pixels of pitch/M and the
    distance R₁R₂/(R₁ + R₂), from source to object R₁ and from object to panel R₂. delta_beta: δ/β of the material. If it or
    the distance is 0, the frames themselves are returned. Beyond the panel, frames continue with their edges' values."""
    reach_mm = filter_reach_mm(distance_mm, energy_kev, delta_beta)
    if reach_mm == 0:
        return frames
    margins = [math.ceil(_REACHES * reach_mm / pitch) for pitch in pixel_mm]
    margins = [min(margin, count) for margin, count in zip(margins, frames.shape[1:], strict=True)]
    shape = [scipy.fft.next_fast_len(n + 2 * m, real=True) for n, m in zip(frames.shape[1:], margins, strict=True)]
    along_v, along_u = np.fft.fftfreq(shape[0], pixel_mm[0]), np.fft.rfftfreq(shape[1], pixel_mm[1])
    response = 1 / (1 + (2 * math.pi * reach_mm) ** 2 * (along_v[:, None] ** 2 + along_u**2))
    inside = tuple(slice(m, m + n) for n, m in zip(frames.shape[1:], margins, strict=True))
    width = [(m, s - n - m) for n, m, s in zip(frames.shape[1:], margins, shape, strict=True)]
    result = np.empty(frames.shape, np.float32)
    for frame, line_integrals in enumerate(frames):
        intensity = np.pad(np.exp(-line_integrals.astype(np.float64)), width, mode="edge")
        smooth = scipy.fft.irfft2(scipy.fft.rfft2(intensity) * response, shape)[inside]
        result[frame] = -np.log(np.maximum(smooth, TRANSMISSION_FLOOR))
    return result


def filter_reach_mm(distance_mm: float, energy_kev: float, delta_beta: float) -> float:
    """Returns the length in mm, in the object's plane, over which the filter's kernel falls to 1/e: √(λ d (δ/β) / 4π), with
    the wavelength λ and the distance d."""
    return math.sqrt(WAVELENGTH_MM_KEV / energy_kev * distance_mm * delta_beta / (4 * math.pi))


def retrieve(scan: Scan, options: PhaseOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """Returns the scan with line integrals of attenuation alone. Raises InputError for a missing distance or material."""
    (energy_kev, delta_beta), geometry = options.stated(), scan.geometry
    pixel_mm = (geometry.pixel_size_mm[0] / geometry.magnification, geometry.pixel_size_mm[1] / geometry.magnification)
    distance_mm = options.distance_mm
    if distance_mm is None:
        if isinstance(geometry, ParallelGeometry):
            expected = "the distance from the object to the panel in mm: a parallel beam states none"
            raise InputError("phase.distance_mm", "nothing", expected, "say --set phase.distance_mm=NUMBER")
        distance_mm = geometry.source_to_detector_mm - geometry.source_to_axis_mm
    distance_mm /= geometry.magnification
    clean = retrieve_phase(unmasked_frames(scan), pixel_mm, distance_mm, energy_kev, delta_beta)
    reach_px = filter_reach_mm(distance_mm, energy_kev, delta_beta) / pixel_mm[1]
    facts = {"effective_distance_mm": distance_mm, "delta_beta": delta_beta, "reach_px": reach_px}
    return replace(scan, projections=clean), facts
