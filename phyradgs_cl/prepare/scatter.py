"""Scatter by a kernel: what a ray loses, P · (−ln P) and P · (−ln P)², comes back as wide Gaussians around it.

Ohnesorge, Flohr and Klingenbeck-Regn, Eur. Radiol. 9 (1999) 563; with the square, thick rays may scatter otherwise than thin
ones, for which Sun and Star-Lack (Phys. Med. Biol. 55 (2010) 6695) take several kernels. The scatter over the primary light
and the width are stated, or it is the sum of Gaussians, none of them negative, that explains best the light that the panel
sees beside the object beyond that of the flats, in frames that may be lighter and darker. It may say too little of what is
behind the object: the kernel is made higher as long as the frames that it leaves explain themselves as well.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.prepare.air import enough_air, with_air_at_0
from phyradgs_cl.prepare.consistency import coarse_model, object_in, smooth, unexplained
from phyradgs_cl.prepare.masked import unmasked_frames
from phyradgs_cl.prepare.step import Facts, MakeModel, Model

Kernel = Mapping[tuple[float, int], float]
"""{(standard deviation as a share of the panel's longer side, power of the line integral): height}"""
_POWERS = (1, 2)  # of a ray's line integral
_REACHES = (0.12, 0.18, 0.27, 0.4)  # of the panel's longer side; narrower ones answer to the gains of columns
_PASSES = 6  # of scatter from primary from scatter
_LEAST_PRIMARY = 0.05  # of what was measured
_SHADOW = 0.1  # of the largest line integral: from here a pixel lies behind the object
_FITTED_FRAMES = 24
_USUAL_REACH = 0.18
_RAISED, _MOST_RAISED = 1.25, 8  # the kernel's height, step by step
_TRIALS = 6  # of heights between the best one's neighbours
_BETTER, _AS_WELL = 0.65, 1.05  # times what the kernel of the air, and the best, leave unexplained


@dataclass(frozen=True)
class ScatterOptions:
    """to_primary: scatter over primary light behind the object; 0: fitted on air. reach: standard deviation of the kernel
    over the panel's longer side; 0: fitted, or 0.18 where to_primary is stated."""

    to_primary: float = 0.0
    reach: float = 0.0

    def __post_init__(self) -> None:
        checks.fields_within("scatter.", self, {"to_primary": (0, 5), "reach": (0, 2)})


def remove_scatter(frames: np.ndarray, kernel: Kernel) -> np.ndarray:
    """Line integrals (F, v, u) without the scatter of a kernel {(standard deviation as a share of the panel's longer side,
    power of a ray's line integral): height}, float32."""
    return -np.log(_primary(np.exp(-frames.astype(np.float64)), kernel)).astype(np.float32)


def fit_scatter(frames: np.ndarray, air: np.ndarray, reach: float = 0.0) -> Kernel:
    """The kernel, of the one width ``reach`` if that is not 0, that explains best the light of the pixels ``air`` of line
    integrals (F, v, u) beyond 1. Frames may be lighter and darker, but not on the mean."""
    chosen = _some(len(frames))
    recorded, where = np.exp(-frames[chosen].astype(np.float64)), air[chosen]
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
    """The kernel as high as leaves line integrals (F, v, u), blurred by so many pixels, best explained, with each frame's
    ``air`` at 0; as it is where none does much better."""
    if not kernel:
        return kernel
    coarse = smooth(frames, blur)
    inside = object_in(model.volume(coarse))

    def left(height: float) -> float:
        clean = with_air_at_0(remove_scatter(coarse, times(height)), air)[0]
        return unexplained(clean, model.volume(clean), inside, model)

    def times(height: float) -> Kernel:
        return {term: height * own for term, own in kernel.items()}

    height, least = 1.0, (before := left(1.0))
    for _ in range(_MOST_RAISED):
        if (further := left(_RAISED * height)) > _AS_WELL * least:
            break
        height, least = _RAISED * height, min(least, further)
    if least >= _BETTER * before:
        return kernel
    beside = height / _RAISED, height * _RAISED
    found = scipy.optimize.minimize_scalar(left, bounds=beside, method="bounded", options={"maxiter": _TRIALS})
    return times(float(found.x))


def subtract_scatter(scan: Scan, options: ScatterOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """The scan without scatter."""
    frames = unmasked_frames(scan)
    if options.to_primary > 0:
        reach = options.reach or _USUAL_REACH
        kernel: Kernel = {(reach, 1): _height_for(frames, options.to_primary, reach)}
    else:
        air = enough_air(frames, 0.05, 0.01, "scatter", "state scatter.to_primary")
        kernel = raised(fit_scatter(frames, air, options.reach), frames, air, *coarse_model(scan, make_model))
    clean = remove_scatter(frames, kernel)
    terms = {"reach": [reach for reach, _ in kernel], "power": [power for _, power in kernel]}
    facts = {**terms, "height": list(kernel.values()), "to_primary": _ratio(frames, clean)}
    return replace(scan, projections=clean), facts


def _height_for(frames: np.ndarray, to_primary: float, reach: float) -> float:
    """The height that leaves this ratio, by bisection: the ratio grows with it."""
    chosen = frames[_some(len(frames))]
    low, high = 0.0, 20.0
    for _ in range(20):
        middle = (low + high) / 2
        below = _ratio(chosen, remove_scatter(chosen, {(reach, 1): middle})) < to_primary
        low, high = (middle, high) if below else (low, middle)
    return (low + high) / 2


def _ratio(before: np.ndarray, after: np.ndarray) -> float:
    """Scatter over primary behind the object."""
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
    return scipy.ndimage.gaussian_filter(source, (0, sigma, sigma), mode="constant")


def _some(frames: int) -> np.ndarray:
    """Which frames heights are fitted to."""
    return np.unique(np.linspace(0, frames - 1, _FITTED_FRAMES).round().astype(int))
