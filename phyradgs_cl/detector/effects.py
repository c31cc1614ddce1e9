"""What panels and tubes do beyond noise: gains that the flats miss, sparks, light that drifts, scatter. All from a seed."""

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.floating]
_SPARK_HEIGHT = (0.3, 2.0)  # of the light without object
_SCATTER_REACH = 6.0  # of the panel's longer side: the exponential's length is one part in so many
_SCATTER_POWERS = (0.8, 1.5)  # of the primary light and of the line integral
_SHADOW = 0.1  # of the largest line integral: from here a pixel lies behind the object


def pixel_gains(shape: tuple[int, int], spread: float, rng: np.random.Generator) -> Array:
    """Gains (v, u) of pixels, normal about 1 with the standard deviation ``spread``; half of it is a whole column's."""
    own, column = rng.standard_normal(shape), rng.standard_normal((1, shape[1]))
    return np.maximum(1 + spread * (np.sqrt(0.75) * own + 0.5 * column), 0.05)


def add_sparks(line_integrals: Array, share: float, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
    """Line integrals (F, v, u) in which a ``share`` of the pixels got light of their own, and which those are."""
    hit = rng.random(line_integrals.shape) < share
    height = rng.uniform(*_SPARK_HEIGHT, int(hit.sum()))
    sparked = np.array(line_integrals)
    sparked[hit] = -np.log(np.exp(-sparked[hit].astype(np.float64)) + height)
    return sparked, hit


def drifting_light(frames: int, largest: float, rng: np.random.Generator) -> Array:
    """The tube's light in each frame (F,) over that of the flats: a wander that is ``largest`` off 1 at its worst."""
    walk = np.cumsum(rng.standard_normal(frames))
    walk -= walk.mean()
    return 1 + largest * walk / max(float(np.abs(walk).max()), 1e-12)


def add_scatter(line_integrals: Array, to_primary: float) -> Array:
    """Line integrals (F, v, u) with scatter, float64: a ray's share P^0.8 p^1.5, as Sun and Star-Lack (Phys. Med. Biol. 55
    (2010) 6695) found for water, spread by a kernel exp(−r/ℓ) over a sixth of the panel. Behind the object it is
    ``to_primary`` times the primary light, on the scan's mean."""
    p = np.asarray(line_integrals, np.float64)
    primary = np.exp(-p)
    lost = primary**_SCATTER_POWERS[0] * np.maximum(p, 0) ** _SCATTER_POWERS[1]
    scatter = np.stack([_spread(frame, max(p.shape[1:]) / _SCATTER_REACH) for frame in lost])
    shadow = p > _SHADOW * p.max()
    if not shadow.any() or scatter[shadow].sum() <= 0:
        return p
    return -np.log(primary + scatter * (to_primary * primary[shadow].sum() / scatter[shadow].sum()))


def _spread(light: Array, length: float) -> Array:
    """A frame (v, u) convolved with exp(−r/length), pixels, of which nothing comes from beyond the panel."""
    v, u = (np.arange(1 - n, n) for n in light.shape)
    kernel = np.exp(-np.hypot(v[:, None], u[None, :]) / length)
    return np.maximum(scipy.signal.fftconvolve(light, kernel / kernel.sum(), mode="same"), 0)
