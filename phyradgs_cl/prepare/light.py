"""Corrects light that changes during a scan: its pattern by flats, its amount by the air in each frame.

- auto: as time, or the mean where the flats come at one time.
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
from phyradgs_cl.detector.attenuation import (
    DARK,
    FLAT,
    PROJECTION,
    TRANSMISSION_FLOOR,
    mean_dark,
    minus_log,
)  # fmt: skip
from phyradgs_cl.detector.noise_level import robust_deviation
from phyradgs_cl.errors import InputError
from phyradgs_cl.io import ToAttenuation, read_scan
from phyradgs_cl.prepare.step import Facts, MakeModel, StepOptions, unmasked_frames

WAYS = ("auto", "mean", "time", "pca")
_MOST_COMPONENTS, _CLEAR = 4, 4.0  # most components used; a component with less than 4 times the median variance is noise
_REWEIGHTINGS = 12  # rounds of least squares, each with new weights
_LEAST_PIXELS = 20  # with fewer pixels of air in a frame, their median is too noisy
_FILTER_NORM = 1.5**0.5  # factor by which the filter (-1/2, 1, -1/2) multiplies the standard deviation of white noise
_AROUND = np.ones((3, 3), bool)
_MARGIN = 2  # pixels this near to the object are no air, because its edge is blurred
_PASSES = 5  # rounds in which the threshold of air follows the air's median
_DARK_SIDES = 5  # the first threshold follows this percentile of the sides, of which an object may cover the rest
_DEVIATIONS = 3.0  # frames are blurred until the limit of air is this many standard deviations of the noise
_FLAT_BLUR = 2 * np.sqrt(np.pi)  # a Gaussian of σ pixels divides the deviation of white noise by this times σ, from 0.5 on
_LEAST_BLUR, _WIDEST_BLUR = 0.5, 1 / 16  # least σ in pixels; largest, as a fraction of the panel's longer side
_SOME_FRAMES = 24  # range and noise are measured in at most this many frames, evenly spread
_DARKEST = 0.25  # air with a larger line integral, of less than 78 % of the flats' light, is rather an object
# Air has fewer pixels around it, of up to 3 times the limit, than this fraction of its own; the slope of an object has more.
_SLOPE = 0.5
_WHOLE = 90  # this percentile of the frames' sums of line integrals shows the whole object: some frames may lack a part
_MISSING = 0.5  # an object whose line integrals sum to less than this fraction of that has been taken for air
Counts = np.ndarray


def flat_correction(way: str) -> ToAttenuation:
    """Returns the function that converts counts to line integrals for ``read_scan``. way: how the function uses the flats
    (``WAYS``).

    The function takes data (F, v, u), image_key (F,), the data's quantity, and when frames were taken (F,), in any unit; by
    default their numbers. It returns line integrals (P, v, u) and bad pixels. It raises InputError for too few flats and,
    with "time" or "pca", for other quantities than "counts"."""
    checks.one_of("flats", way, WAYS)
    return counts_to_attenuation if way == "auto" else partial(_with_flats, way)


def read_corrected(path: str | Path, flats: str = "auto", rows: tuple[int, int] | None = None) -> Scan:
    """Reads a scan file, or its rows [first, stop), as line integrals (``flat_correction``). Raises as ``io.read_scan``."""
    scan = read_scan(path, flat_correction(flats), rows)
    return scan if flats == "auto" else replace(scan, provenance={**scan.provenance, "flats": flats})


def _with_flats(
    way: str, data: Counts, image_key: np.ndarray, quantity: str, at: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    if way == "mean":
        return counts_to_attenuation(data, image_key, quantity)
    flats = np.flatnonzero(image_key == FLAT)
    needed = 2 if way == "time" else 3
    if quantity != "counts" or len(flats) < needed:
        found, remedy = f"{quantity} with {len(flats)} flats", "take the mean of the flats (flats=mean)"
        raise InputError(f"flats={way}", found, f"counts with at least {needed} flats", remedy)
    if way == "time":
        return counts_to_attenuation(data, image_key, quantity, np.arange(len(data)) if at is None else at)
    numbers, dark = np.flatnonzero(image_key == PROJECTION), mean_dark(data[image_key == DARK], data.shape[1:])
    signal = np.maximum(data[flats].astype(np.float64) - dark, 0)
    lights = _of_components(signal, (data[frame] - dark for frame in numbers))
    result = np.empty((len(numbers), *data.shape[1:]), np.float32)
    bad = np.empty(result.shape, bool)
    for i, (frame, light) in enumerate(zip(numbers, lights, strict=True)):
        result[i], bad[i] = minus_log(data[frame] - dark, light)
    return result, bad


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
class AirOptions(StepOptions, step="air"):
    """Options of the step ``air``. below: pixels are air if they exceed the air of their frame by less than this fraction of
    the scan's range of line integrals, and connect to the panel's left or right side. least: least fraction of air in every
    frame."""

    below: float = checks.ranged(0.05, 1e-4, 0.2)
    least: float = checks.ranged(0.01, 0, 1)


def normalise_air(scan: Scan, options: AirOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """Returns the scan with each frame shifted so that the median of its air is 0."""
    frames = unmasked_frames(scan)
    air = enough_air(frames, options.below, options.least, "air", "leave the step out, or try another air.below")
    clean, value = with_air_at_0(frames, air)
    light = np.exp(-value)
    facts = {"light": [float(light.min()), float(light.max())], "air_share": float(air.mean())}
    return replace(scan, projections=clean), facts


def find_air(frames: np.ndarray, *, below: float = 0.05) -> np.ndarray:
    """Returns the pixels of line integrals (F, v, u) that no object covers, bool (F, v, u).

    They exceed their frame's level by less than the fraction ``below`` of the scan's range, are connected with the first or
    last column through such pixels, and lie more than two pixels away from all others. The level is their median. Noise is
    blurred first, until it hardly exceeds that limit. A frame has no air if its level is too dark for a drift, if the sides
    are a slope, as of an object that reaches them, or if much of the object would be missing without what looks like air."""
    blur, limit = _blur_and_limit(frames, below)
    margin = _MARGIN + round(blur)
    air = np.empty(frames.shape, bool)
    levels, total = np.full(len(frames), np.inf), frames.sum(axis=(1, 2), dtype=np.float64)
    for f, frame in enumerate(frames):
        smooth = scipy.ndimage.gaussian_filter(frame, blur) if blur else frame
        level = float(np.percentile(smooth[:, [0, -1]], _DARK_SIDES))
        for _ in range(_PASSES):
            reached = _from_sides(smooth < level + limit)
            level = float(np.median(smooth[reached])) if reached.any() else np.inf
        around = np.count_nonzero(_from_sides(smooth < level + 3 * limit)) - np.count_nonzero(reached)
        if level < _DARKEST and around < _SLOPE * np.count_nonzero(reached):
            levels[f] = level
        air[f] = scipy.ndimage.binary_erosion(reached, _AROUND, iterations=margin, border_value=1)
    left = total - levels * frames[0].size
    usual = float(np.percentile(left[np.isfinite(levels)], _WHOLE)) if np.isfinite(levels).any() else 0.0
    is_covered = (left < _MISSING * usual) & (levels > limit) & (np.abs(total - usual) < np.abs(left - usual))
    air[is_covered | np.isinf(levels)] = False
    return air


def _blur_and_limit(frames: np.ndarray, below: float) -> tuple[float, float]:
    """Returns the blur σ in pixels of line integrals (F, v, u) that makes the air's noise small against the limit, and the
    limit: how far above its frame's level air may be."""
    some = frames[np.unique(np.linspace(0, len(frames) - 1, _SOME_FRAMES).round().astype(int))]
    low, high = np.percentile(scipy.ndimage.gaussian_filter(some, (0, _MARGIN, _MARGIN)), (1, 99.9))
    limit = below * float(high - low)
    noises = []  # of each frame's brighter half
    for frame in some:
        second = frame[:, 1:-1] - 0.5 * (frame[:, :-2] + frame[:, 2:])
        mean = scipy.ndimage.uniform_filter(frame, 5)[:, 1:-1]
        noises.append(robust_deviation(second[mean <= np.median(mean)]) / _FILTER_NORM)
    noise = float(np.median(noises))
    blur = min(_DEVIATIONS * noise / max(_FLAT_BLUR * limit, 1e-12), _WIDEST_BLUR * max(frames.shape[1:]))
    if blur < _LEAST_BLUR:
        return 0.0, limit
    return blur, max(limit, _DEVIATIONS * noise / (_FLAT_BLUR * blur))


def _from_sides(low: np.ndarray) -> np.ndarray:
    """Returns the pixels of ``low``, bool (v, u), that connect with the first or last column through such pixels."""
    sides = np.zeros_like(low)
    sides[:, [0, -1]] = low[:, [0, -1]]
    return np.asarray(scipy.ndimage.binary_propagation(sides, _AROUND, mask=low))


def enough_air(frames: np.ndarray, below: float, least: float, step: str, remedy: str) -> np.ndarray:
    """Returns the air, bool (F, v, u), by ``find_air``. Raises InputError, which names --steps ``step``, where a frame has
    fewer than 20 pixels of air, or a smaller fraction than ``least``."""
    air = find_air(frames, below=below)
    counts = air.sum(axis=(1, 2))
    needed = max(_LEAST_PIXELS, int(np.ceil(least * frames[0].size)))
    if counts.min() < needed:
        worst = int(np.argmin(counts))
        expected = f"at least {needed} of one brightness at the panel's sides"
        raise InputError(f"--steps {step}", f"{counts[worst]} pixels of air in frame {worst}", expected, remedy)
    return air


def with_air_at_0(frames: np.ndarray, air: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shifts each frame of line integrals (F, v, u) so that its median over ``air`` is 0. Also returns the medians (F,)."""
    value = np.array([np.median(frame[where]) for frame, where in zip(frames, air, strict=True)])
    return frames - value[:, None, None].astype(np.float32), value
