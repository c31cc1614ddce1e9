"""Removes scatter by a kernel: a ray of transmission P scatters P · (−ln P) and P · (−ln P)², spread by wide Gaussians.

Ohnesorge, Flohr and Klingenbeck-Regn, Eur. Radiol. 9 (1999) 563. The square lets thick rays scatter differently from thin
ones, for which Sun and Star-Lack (Phys. Med. Biol. 55 (2010) 6695) take several kernels. The user states the width and the
ratio of scatter to primary light. Otherwise a non-negative sum of Gaussians is fitted to the light in air beyond that of the
flats, while each frame's light may vary. This may underestimate scatter behind the object, so stronger kernels are tried
too. A stronger kernel is taken if the frames that it corrects agree far better with their own reprojection."""

import itertools
import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare import step
from phyradgs_cl.prepare.light import enough_air, with_air_at_0
from phyradgs_cl.prepare.step import Facts, MakeModel, Model, StepOptions

log = logging.getLogger(__name__)
Kernel = Mapping[tuple[float, int], float]
"""Strength of each Gaussian. Its key has its standard deviation, as a fraction of the panel's longer side, and the power n
in the light P · (−ln P)ⁿ that it spreads."""
_POWERS = (1, 2)  # powers of a ray's line integral to which scatter is fitted: the square tells thick rays from thin ones
# Standard deviations of the fitted Gaussians, as fractions of the panel's longer side. Narrower ones would fit columns of
# wrong gain. The widest is an even haze.
_REACHES = (0.12, 0.18, 0.27, 0.4, 2.0)
_SHORT = 0.4  # wider Gaussians are cut off where no pixel of the panel is farther away, which saves time
_PASSES = 6  # rounds that compute scatter from the primary light, then primary light from the scatter
_LEAST_PRIMARY = 0.05  # overestimated scatter leaves at least this fraction of the light, so that its logarithm is finite
_SHADOW = 0.1  # pixels above this fraction of the largest line integral lie behind the object
_FITTED_FRAMES = 24  # the fit uses at most this many frames, evenly spread, to save time
_USUAL_REACH = 0.18  # kernel's standard deviation / panel's longer side, where only to_primary is stated
_HEIGHT_STEP = 1.25  # each kernel that is tried is stronger than the one before by this factor
_MOST_STEPS = 8  # at most this many steps make the kernel stronger, up to 6 times the fitted one
_TRIALS = 6  # most strengths tried in the final search, between the neighbours of the best one
# A stronger kernel is taken if it leaves less than this fraction of the rest that the fitted kernel leaves unexplained.
_BETTER = 0.65
_AS_WELL = 1.05  # no stronger kernel is tried after one that leaves over this many times the least unexplained rest so far
_LEAST_RATIO = 0.01  # a ratio (scatter)/(primary light) behind the object below this is not told from 0
# Light in air, beyond that of the flats, is unexplained if more than these fractions of the flats and of itself stay.
_LEFT, _LEFT_OF_IT = 0.01, 0.3
_LARGEST_HEIGHT = 1000.0  # no kernel for a stated to_primary is stronger than this
_BISECTIONS = 26  # halvings of the interval from 0 to 1000 that give the strength for a stated to_primary to within 2e-5
_SAME_RATIO = 0.25  # a kernel gives a stated to_primary if its ratio differs by at most this fraction


@dataclass(frozen=True)
class ScatterOptions(StepOptions, step="scatter"):
    """Options of the step ``scatter``. to_primary: ratio of scatter to primary light behind the object; 0: the kernel is
    fitted to air. reach: standard deviation of the kernel, as a fraction of the panel's longer side; 0: fitted, or 0.18 if
    to_primary is stated."""

    to_primary: float = checks.ranged(0.0, 0, 5)
    reach: float = checks.ranged(0.0, 0, 2)


def subtract_scatter(scan: Scan, options: ScatterOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    frames = step.unmasked_frames(scan)
    if options.to_primary > 0:
        reach = options.reach or _USUAL_REACH
        kernel: Kernel = {(reach, 1): _height_for(frames, options.to_primary, reach)}
    else:
        air = enough_air(frames, 0.05, 0.01, "scatter", "state scatter.to_primary")
        fitted = fit_scatter(frames, air, options.reach)
        kernel = raised(fitted, frames, air, *step.coarse_model(scan, make_model))
    clean = remove_scatter(frames, kernel)
    ratio = _ratio(frames, clean)
    if options.to_primary == 0:
        light, left = (float(np.expm1(-np.median(one[air]))) for one in (frames, clean))
        if left > max(_LEFT, _LEFT_OF_IT * light):
            text = "scatter: air has %.1f %% more light than the flats; %.1f %% stay, %s"
            log.warning(text, 100 * light, 100 * left, "which no scatter of the object explains")
    if options.to_primary == 0 and ratio < _LEAST_RATIO:
        return scan, {"result": "no scatter found in the light beside the object: the projections stay as they are"}
    if options.to_primary > 0 and abs(ratio - options.to_primary) > _SAME_RATIO * options.to_primary:
        # a thin object scatters little in this model: as the kernel grows stronger, the ratio jumps past to_primary
        expected = f"a ratio that the kernel gives, here {ratio:.2g}"
        raise InputError("scatter.to_primary", f"{options.to_primary:g}", expected, "leave thin objects without this step")
    terms = {"reach": [reach for reach, _ in kernel], "power": [power for _, power in kernel]}
    facts = {**terms, "height": list(kernel.values()), "to_primary": ratio}
    return replace(scan, projections=clean), facts


def remove_scatter(frames: np.ndarray, kernel: Kernel) -> np.ndarray:
    """Returns line integrals (F, v, u) float32 without the scatter that ``kernel`` predicts from ``frames`` (F, v, u)."""
    return -np.log(_primary(np.exp(-frames.astype(np.float64)), kernel)).astype(np.float32)


def fit_scatter(frames: np.ndarray, air: np.ndarray, reach: float = 0.0) -> Kernel:
    """Fits the kernel by non-negative least squares: in air the scatter is (transmission − 1).

    frames: line integrals (F, v, u); air, bool (F, v, u): pixels without object. reach: as in ``_REACHES``; 0: to be fitted.
    The light of frames may vary, but its mean over the frames must be that of the flats."""
    numbers = _some(len(frames))
    recorded, where = np.exp(-frames[numbers].astype(np.float64)), air[numbers]
    terms = list(itertools.product((reach,) if reach > 0 else _REACHES, _POWERS))
    kernel: dict[tuple[float, int], float] = {}
    light = recorded
    for _ in range(_PASSES):
        primary = _primary(light, kernel)
        shapes = np.stack([_scattered(primary, *term) for term in terms], axis=-1)
        heights = scipy.optimize.nnls(shapes[where], light[where] - 1)[0]
        kernel = dict(zip(terms, map(float, heights), strict=True))
        over = recorded / (1 + shapes @ heights)
        gain = np.array([np.median(frame[beside]) for frame, beside in zip(over, where, strict=True)])
        light = recorded / (gain / gain.mean())[:, None, None]
    return {term: height for term, height in kernel.items() if height > 0}


def raised(kernel: Kernel, frames: np.ndarray, air: np.ndarray, model: Model, blur: float = 0.0) -> Kernel:
    """Returns the kernel with the strength that leaves the least ``unexplained`` rest, or ``kernel`` itself unless that rest
    is below 0.65 times the rest of ``kernel``. frames: line integrals (F, v, u), first blurred by ``blur`` pixels to fit a
    coarse model. The corrected frames are shifted so that the median of each frame's ``air``, bool (F, v, u), is 0."""
    if not kernel:
        return kernel
    coarse = step.smooth(frames, blur)
    inside = step.object_in(model.volume(coarse))

    def rest(height: float) -> float:
        clean = with_air_at_0(remove_scatter(coarse, times(height)), air)[0]
        return step.unexplained(clean, model.volume(clean), inside, model)

    def times(height: float) -> Kernel:
        return {term: height * value for term, value in kernel.items()}

    fitted = rest(1.0)
    height, best, least = 1.0, 1.0, fitted
    for _ in range(_MOST_STEPS):
        height *= _HEIGHT_STEP
        higher = rest(height)
        if higher < least:
            best, least = height, higher
        elif higher > _AS_WELL * least:
            break
    if least >= _BETTER * fitted:
        return kernel
    # the minimum lies between the two neighbours of the best strength tried
    bounds = best / _HEIGHT_STEP, best * _HEIGHT_STEP
    found = scipy.optimize.minimize_scalar(rest, bounds=bounds, method="bounded", options={"maxiter": _TRIALS})
    return times(float(found.x))


def _height_for(frames: np.ndarray, to_primary: float, reach: float) -> float:
    """Returns the kernel's strength that gives the ratio ``to_primary``, by bisection: the ratio grows with the strength."""
    some = frames[_some(len(frames))]
    low, high = 0.0, _LARGEST_HEIGHT
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        is_low = _ratio(some, remove_scatter(some, {(reach, 1): middle})) < to_primary
        low, high = (middle, high) if is_low else (low, middle)
    return low


def _ratio(before: np.ndarray, after: np.ndarray) -> float:
    """Returns scatter / primary light behind the object, from line integrals before and after the removal of scatter."""
    shadow = after > _SHADOW * float(np.percentile(after, 99.9))
    primary = float(np.exp(-after[shadow].astype(np.float64)).sum())
    return float(np.exp(-before[shadow].astype(np.float64)).sum()) / max(primary, 1e-20) - 1


def _primary(recorded: np.ndarray, kernel: Kernel) -> np.ndarray:
    primary = recorded
    for _ in range(_PASSES if kernel else 0):
        scatter = sum(height * _scattered(primary, *term) for term, height in kernel.items())
        primary = np.maximum(recorded - scatter, _LEAST_PRIMARY * recorded)
    return primary


def _scattered(primary: np.ndarray, reach: float, power: int) -> np.ndarray:
    source = primary * np.maximum(-np.log(np.maximum(primary, 1e-12)), 0) ** power
    sigma = reach * max(primary.shape[1:])
    truncate = 4.0 if reach <= _SHORT else 1 / reach
    return scipy.ndimage.gaussian_filter(source, (0, sigma, sigma), mode="constant", truncate=truncate)


def _some(frames: int) -> np.ndarray:
    return np.unique(np.linspace(0, frames - 1, _FITTED_FRAMES).round().astype(int))
