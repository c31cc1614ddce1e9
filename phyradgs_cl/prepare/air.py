"""Light that drifts: every frame's own value of air, from its pixels beside the object (as in nabu and algotom's ROI
normalisation), in place of what the flats say of another time."""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.prepare.masked import unmasked_frames
from phyradgs_cl.prepare.step import Facts, MakeModel

_LEAST_PIXELS = 20
_AROUND = np.ones((3, 3), bool)
_MARGIN = 2  # pixels that are kept from the object's edge
_PASSES = 3  # as the threshold moves with the value that is found


@dataclass(frozen=True)
class AirOptions:
    """below: share of the scan's largest line integral below which a pixel may be air, if it is connected with a side of the
    panel; least: share of a frame's pixels that must be."""

    below: float = 0.05
    least: float = 0.01

    def __post_init__(self) -> None:
        checks.fields_within("air.", self, {"below": (1e-4, 0.5), "least": (0, 1)})


def find_air(frames: np.ndarray, *, below: float = 0.05) -> np.ndarray:
    """Pixels of line integrals (F, v, u) that no object covers, bool (F, v, u): those below the share ``below`` of the
    largest, connected with the first or last column, two pixels from all others."""
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
    """``find_air``; InputError where a frame has too little."""
    air = find_air(frames, below=below)
    counts = air.sum(axis=(1, 2))
    needed = max(_LEAST_PIXELS, int(np.ceil(least * frames[0].size)))
    if counts.min() < needed:
        worst = int(np.argmin(counts))
        raise InputError(f"--steps {step}", f"{counts[worst]} pixels of air in frame {worst}", f"at least {needed}", remedy)
    return air


def with_air_at_0(frames: np.ndarray, air: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Line integrals (F, v, u) with the median of each frame's pixels ``air`` taken to 0, and these medians (F,)."""
    value = np.array([np.median(frame[where]) for frame, where in zip(frames, air, strict=True)])
    return frames - value[:, None, None].astype(np.float32), value


def normalise_air(scan: Scan, options: AirOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """The scan with the median of each frame's air taken to 0."""
    frames = unmasked_frames(scan)
    air = enough_air(frames, options.below, options.least, "air", "leave the step out, or lower air.least")
    clean, value = with_air_at_0(frames, air)
    light = np.exp(-value)
    facts = {"light": [float(light.min()), float(light.max())], "air_share": float(air.mean())}
    return replace(scan, projections=clean), facts
