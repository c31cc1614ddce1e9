"""Flats that change during a scan: interpolated in time, or as many eigen-flats as they say.

time: linearly between the means of flats that were taken together, in the order of the stored frames. pca: per frame the
combination of their principal components that leaves the least total variation, in logarithms; Van Nieuwenhove et al., Opt.
Express 23 (2015) 27975. What they cannot see, one number per frame, is the step ``air``'s.
"""

from collections.abc import Callable, Sequence

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.detector.attenuation import DARK, FLAT, PROJECTION, TRANSMISSION_FLOOR
from phyradgs_cl.errors import InputError

WAYS = ("mean", "time", "pca")
_MOST_COMPONENTS, _CLEAR = 4, 4.0  # components, and how far their variance is above the middle one's
_REWEIGHTINGS = 12
Counts = np.ndarray
ToAttenuation = Callable[[Counts, np.ndarray, str], tuple[np.ndarray, np.ndarray | None]]


def flat_correction(way: str) -> ToAttenuation:
    """What ``read_scan`` takes: (data (F, v, u), image_key (F,), quantity) to line integrals (P, v, u) and bad pixels, with
    flats as ``way`` says. What it gives raises InputError for what has no flats, or too few."""
    checks.one_of("flats", way, WAYS)
    if way == "mean":
        return counts_to_attenuation

    def convert(data: Counts, image_key: np.ndarray, quantity: str) -> tuple[np.ndarray, np.ndarray]:
        flats = np.flatnonzero(image_key == FLAT)
        needed = 2 if way == "time" else 3
        if quantity != "counts" or len(flats) < needed:
            found = f"{quantity} with {len(flats)} flats"
            remedy = "take the mean of the flats (flats=mean)"
            raise InputError(f"flats={way}", found, f"counts with at least {needed} flats", remedy)
        darks = data[image_key == DARK]
        dark = darks.mean(axis=0, dtype=np.float64) if len(darks) else np.zeros(data.shape[1:])
        signal = np.maximum(data[flats].astype(np.float64) - dark, 0)
        chosen = np.flatnonzero(image_key == PROJECTION)
        light = _in_time(signal, flats, chosen) if way == "time" else _of_components(signal, data, dark, chosen)
        return _converted(data, dark, light, chosen)

    return convert


def _converted(
    data: Counts, dark: np.ndarray, light: Callable[[int], np.ndarray], chosen: Sequence[int] | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    result = np.empty((len(chosen), *data.shape[1:]), np.float32)
    bad = np.empty(result.shape, bool)
    for i, frame in enumerate(chosen):
        flat = light(i)
        transmission = np.divide(data[frame] - dark, flat, out=np.zeros(flat.shape), where=flat > 0)
        bad[i] = ~(np.isfinite(transmission) & (transmission > TRANSMISSION_FLOOR))
        result[i] = -np.log(np.where(bad[i], 1, transmission))
    return result, bad


def _in_time(signal: np.ndarray, flats: np.ndarray, chosen: np.ndarray) -> Callable[[int], np.ndarray]:
    groups = np.split(np.arange(len(flats)), np.flatnonzero(np.diff(flats) > 1) + 1)
    time = np.array([flats[group].mean() for group in groups])
    means = np.stack([signal[group].mean(axis=0) for group in groups])

    def light(i: int) -> np.ndarray:
        share = np.array([np.interp(chosen[i], time, unit) for unit in np.eye(len(time))])
        return np.tensordot(share, means, axes=1)

    return light


def _of_components(
    signal: np.ndarray, data: Counts, dark: np.ndarray, chosen: np.ndarray
) -> Callable[[int], np.ndarray]:
    mean = signal.mean(axis=0)
    live = mean > 0
    ratio = np.divide(signal, mean, out=np.ones_like(signal), where=live)
    logs = np.log(np.maximum(ratio, TRANSMISSION_FLOOR)).reshape(len(signal), -1)
    _, size, components = np.linalg.svd(logs - logs.mean(axis=0), full_matrices=False)
    size = size[: len(signal) - 1]  # the mean took one
    clear = size**2 > _CLEAR * np.median(size**2) if len(size) > 2 else size > 0
    kept = components[: len(size)][clear][:_MOST_COMPONENTS].reshape(-1, *mean.shape)

    def light(i: int) -> np.ndarray:
        seen = np.divide(data[chosen[i]] - dark, mean, out=np.ones(mean.shape), where=live)
        weights = _least_variation(np.log(np.maximum(seen, TRANSMISSION_FLOOR)), kept)
        return mean * np.exp(np.tensordot(weights, kept, axes=1))

    return light if len(kept) else lambda i: mean


def _least_variation(frame: np.ndarray, components: np.ndarray) -> np.ndarray:
    """The weights (k,) of components (k, v, u) that take the least total variation out of a frame (v, u): least squares,
    again and again, with each difference weighed by its inverse size."""

    def differences(image: np.ndarray) -> np.ndarray:
        return np.concatenate([np.diff(image, axis=axis).ravel() for axis in (-2, -1)])

    wanted, basis = differences(frame), np.stack([differences(c) for c in components], axis=1)
    weights = np.zeros(len(components))
    for _ in range(_REWEIGHTINGS):
        rest = np.abs(wanted - basis @ weights)
        inverse = 1 / np.maximum(rest, 1e-3 * max(float(rest.mean()), 1e-12))
        scaled = basis * inverse[:, None]
        weights = np.linalg.lstsq(scaled.T @ basis, scaled.T @ wanted, rcond=None)[0]
    return weights
