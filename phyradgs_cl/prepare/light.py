"""Corrects light that changes during a scan: its pattern by flats, its amount by the air in each frame.

- mean: all flats are averaged.
- time: flats without a projection between them are averaged, and these means interpolated linearly in time. Without times
  the stored frames' numbers stand for them.
- pca: each frame gets the combination of the flats' principal components that leaves the least total variation, in
  logarithms (Van Nieuwenhove et al., Opt. Express 23 (2015) 27975).

The step ``air`` corrects each frame's amount of light by the pixels that no object covers, as nabu and algotom do."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.detector.attenuation import DARK, FLAT, PROJECTION, TRANSMISSION_FLOOR, mean_dark, minus_log
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import ToAttenuation, read_scan
from phyradgs_cl.prepare.step import Facts, MakeModel, unmasked_frames

WAYS = ("mean", "time", "pca")
_MOST_COMPONENTS, _CLEAR = 4, 4.0  # most components used; a component with less than 4 times the median variance is noise
_REWEIGHTINGS = 12  # rounds of least squares, each with new weights
_LEAST_PIXELS = 20  # with fewer pixels of air in a frame, their median is too noisy
_AROUND = np.ones((3, 3), bool)
_MARGIN = 2  # pixels this near to the object are no air, because its edge is blurred
_PASSES = 3  # rounds in which the threshold of air follows the air's median, which bright or dim light shifts
Counts = np.ndarray


def flat_correction(way: str) -> ToAttenuation:
    """Returns the function that converts counts to line integrals for ``read_scan``. way: how the function uses the flats
    (``WAYS``).

    The function takes data (F, v, u), image_key (F,), the data's quantity, and when frames were taken (F,), in any unit; by
    default their numbers. It returns line integrals (P, v, u) and bad pixels. It raises InputError for too few flats and,
    with "time" or "pca", for other quantities than "counts"."""
    checks.one_of("flats", way, WAYS)
    return counts_to_attenuation if way == "mean" else partial(_with_changing_flats, way)


def read_corrected(path: str | Path, flats: str = "mean", rows: tuple[int, int] | None = None) -> Scan:
    """Reads a scan file, or its rows [first, stop), as line integrals (``flat_correction``). Raises as ``io.read_scan``."""
    scan = read_scan(path, flat_correction(flats), rows)
    return scan if flats == "mean" else replace(scan, provenance={**scan.provenance, "flats": flats})


def _with_changing_flats(
    way: str, data: Counts, image_key: np.ndarray, quantity: str, at: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    flats = np.flatnonzero(image_key == FLAT)
    needed = 2 if way == "time" else 3
    if quantity != "counts" or len(flats) < needed:
        found, remedy = f"{quantity} with {len(flats)} flats", "take the mean of the flats (flats=mean)"
        raise InputError(f"flats={way}", found, f"counts with at least {needed} flats", remedy)
    dark = mean_dark(data[image_key == DARK], data.shape[1:])
    signal = np.maximum(data[flats].astype(np.float64) - dark, 0)
    numbers = np.flatnonzero(image_key == PROJECTION)
    counts = (data[frame] - dark for frame in numbers)
    at = np.arange(len(data)) if at is None else at
    lights = _in_time(signal, at[flats], at[numbers]) if way == "time" else _of_components(signal, counts)
    result = np.empty((len(numbers), *data.shape[1:]), np.float32)
    bad = np.empty(result.shape, bool)
    for i, (frame, light) in enumerate(zip(numbers, lights, strict=True)):
        result[i], bad[i] = minus_log(data[frame] - dark, light)
    return result, bad


def _in_time(signal: np.ndarray, flats_at: np.ndarray, at: np.ndarray) -> Iterator[np.ndarray]:
    """Yields each projection's flat (v, u): the means of flats without a projection between them, interpolated linearly.
    flats_at (n,), at (P,): when flats and projections were taken."""
    place = np.searchsorted(np.sort(at), flats_at)
    groups = [place == one for one in np.unique(place)]
    time = np.array([flats_at[group].mean() for group in groups])
    means = np.stack([signal[group].mean(axis=0) for group in groups])
    for moment in at:
        share = np.array([np.interp(moment, time, unit) for unit in np.eye(len(time))])
        yield np.tensordot(share, means, axes=1)


def _of_components(signal: np.ndarray, counts: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yields the flat (v, u) for each projection's counts (v, u), from principal components of the flats' logarithms."""
    mean = signal.mean(axis=0)
    live = mean > 0
    ratio = np.divide(signal, mean, out=np.ones_like(signal), where=live)
    logs = np.log(np.maximum(ratio, TRANSMISSION_FLOOR)).reshape(len(signal), -1)
    _, size, components = np.linalg.svd(logs - logs.mean(axis=0), full_matrices=False)
    size = size[: len(signal) - 1]  # subtracting the mean leaves one component fewer than there are flats
    clear = size**2 > _CLEAR * np.median(size**2) if len(size) > 2 else size > 0
    used = components[: len(size)][clear][:_MOST_COMPONENTS].reshape(-1, *mean.shape)
    if not len(used):
        yield from (mean for _ in counts)
        return
    for count in counts:
        ratio = np.divide(count, mean, out=np.ones(mean.shape), where=live)
        weights = _least_variation(np.log(np.maximum(ratio, TRANSMISSION_FLOOR)), used)
        yield mean * np.exp(np.tensordot(weights, used, axes=1))


def _least_variation(frame: np.ndarray, components: np.ndarray) -> np.ndarray:
    """Returns the weights (k,) of components (k, v, u) whose subtraction leaves frame (v, u) with the least total variation:
    least squares, repeated with weights 1/|difference|, which turn squares into absolute values."""

    def differences(image: np.ndarray) -> np.ndarray:
        return np.concatenate([np.diff(image, axis=axis).ravel() for axis in (-2, -1)])

    wanted, basis = differences(frame), np.stack([differences(c) for c in components], axis=1)
    weights = np.zeros(len(components))
    for _ in range(_REWEIGHTINGS):
        residual = np.abs(wanted - basis @ weights)
        inverse = 1 / np.maximum(residual, 1e-3 * max(float(residual.mean()), 1e-12))
        scaled = basis * inverse[:, None]
        weights = np.linalg.lstsq(scaled.T @ basis, scaled.T @ wanted, rcond=None)[0]
    return weights


@dataclass(frozen=True)
class AirOptions(checks.Checked):
    """Options of the step ``air``. below: pixels are air if they lie below this fraction of the scan's largest line integral
    and connect to the panel's left or right side. least: least fraction of air in every frame."""

    PREFIX = "air."

    below: float = checks.ranged(0.05, 1e-4, 0.5)
    least: float = checks.ranged(0.01, 0, 1)


def normalise_air(scan: Scan, options: AirOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """Returns the scan with each frame shifted so that the median of its air is 0."""
    frames = unmasked_frames(scan)
    air = enough_air(frames, options.below, options.least, "air", "raise air.below, or leave the step out")
    clean, value = with_air_at_0(frames, air)
    light = np.exp(-value)
    facts = {"light": [float(light.min()), float(light.max())], "air_share": float(air.mean())}
    return replace(scan, projections=clean), facts


def find_air(frames: np.ndarray, *, below: float = 0.05) -> np.ndarray:
    """Returns the pixels of line integrals (F, v, u) that no object covers, bool (F, v, u).

    They exceed the air's median by less than the fraction ``below`` of the largest line integral (99.9th percentile), are
    connected with the first or last column through such pixels, and lie more than two pixels away from all others."""
    limit = below * float(np.percentile(frames, 99.9))
    air = np.empty(frames.shape, bool)
    for f, frame in enumerate(frames):
        low, value = frame < limit, 0.0
        for _ in range(_PASSES):
            sides = np.zeros_like(low)
            sides[:, [0, -1]] = low[:, [0, -1]]
            reached = scipy.ndimage.binary_propagation(sides, _AROUND, mask=low)
            value = float(np.median(frame[reached])) if reached.any() else 0.0
            low = frame < limit + value
        air[f] = scipy.ndimage.binary_erosion(reached, _AROUND, iterations=_MARGIN, border_value=1)
    return air


def enough_air(frames: np.ndarray, below: float, least: float, step: str, remedy: str) -> np.ndarray:
    """Returns the air, bool (F, v, u), by ``find_air``. Raises InputError, which names --steps ``step``, where a frame has
    fewer than 20 pixels of air, or a smaller fraction than ``least``."""
    air = find_air(frames, below=below)
    counts = air.sum(axis=(1, 2))
    needed = max(_LEAST_PIXELS, int(np.ceil(least * frames[0].size)))
    if counts.min() < needed:
        worst = int(np.argmin(counts))
        raise InputError(f"--steps {step}", f"{counts[worst]} pixels of air in frame {worst}", f"at least {needed}", remedy)
    return air


def with_air_at_0(frames: np.ndarray, air: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shifts each frame of line integrals (F, v, u) so that its median over ``air`` is 0. Also returns the medians (F,)."""
    value = np.array([np.median(frame[where]) for frame, where in zip(frames, air, strict=True)])
    return frames - value[:, None, None].astype(np.float32), value
