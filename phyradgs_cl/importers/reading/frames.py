"""Raw frames of any origin to line integrals with row 0 the lowest, with bad pixels masked."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from phyradgs_cl.acquisition import Saturation
from phyradgs_cl.acquisition.scan import applied_facts
from phyradgs_cl.detector import find_saturation, frames_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.io.scan.reader import LARGEST_LINE_INTEGRAL

_log = logging.getLogger(__name__)
Mask = np.ndarray | None
_SAME = 1e-3  # relative difference of a flat that is at the ceiling too


@dataclass(frozen=True, eq=False)
class LineIntegrals:
    """Line integrals (P, v, u) float32, the pixels not to be used, what raw counts said of the panel's ceiling, and how many
    flats and darks were applied to them, as provenance."""

    values: np.ndarray
    mask: Mask
    saturation: Saturation | None = None
    applied: Mapping[str, object] = field(default_factory=dict)


def line_integrals(
    subject: str,
    frames: np.ndarray,
    options: ImportOptions,
    *,
    flats: np.ndarray | None = None,
    darks: np.ndarray | None = None,
    custom: str | None = None,
) -> LineIntegrals:
    """Line integrals of ``frames`` (P, v, u) of any real type; clipped counts and values that no object has are masked,
    and said. ``subject`` names the file; ``flats``, ``darks``: (n, v, u) or None. The options' ``quantity`` wins over
    ``custom``, the format's or file's; where neither says, frames with flats are counts and others refused."""
    has_flats = (flats is not None and len(flats) > 0) or options.flat_value is not None
    quantity = options.quantity or custom or ("counts" if has_flats else None)
    if quantity is None:
        remedy = f"say {options.named('quantity')} attenuation, transmission or counts"
        raise InputError(f"{subject} quantity", "nothing that says it", "what the pixels hold", remedy)
    saturation = flat = None
    if quantity == "counts":
        if options.flat_value is not None or flats is None or len(flats) == 0:
            flats = _constant_flat(subject, frames, options)
        for stack in (flats, darks):
            if stack is not None and len(stack) and stack.shape[1:] != frames.shape[1:]:
                found = f"flats or darks of {stack.shape[1:]}"
                raise InputError(subject, found, f"the projections' {frames.shape[1:]} pixels")
        with np.errstate(over="ignore", invalid="ignore"):
            flat = flats.mean(axis=0, dtype=np.float64)
            saturation = find_saturation(frames, flat)
    integrals, unusable = frames_to_attenuation(frames, quantity, flats, darks, LARGEST_LINE_INTEGRAL)
    if quantity == "attenuation" and unusable.any():
        text = "%s: %d line integrals are not finite or beyond %g: masked"
        _log.warning(text, subject, np.count_nonzero(unusable), LARGEST_LINE_INTEGRAL)
    if flat is not None and saturation is not None and saturation.share > 0:
        _mask_clipped(subject, frames, flat, saturation, unusable)
    is_divided = quantity == "counts" and options.flat_value is None
    counts = [len(stack) if is_divided and stack is not None else 0 for stack in (flats, darks)]
    return LineIntegrals(integrals, compact(unusable), saturation, applied_facts(*counts))


def _mask_clipped(
    subject: str, frames: np.ndarray, flat: np.ndarray, saturation: Saturation, unusable: np.ndarray
) -> None:
    """Masks each frame's clipped pixels where the flat is brighter, so that even air would read as an object. Where the
    flat is clipped too the integral is 0: right for air, which is most of it; without air a reconstruction is 2 to 3
    times further off than with thin parts lost."""
    brighter = flat > saturation.level * (1 + _SAME)
    for frame, bad in zip(frames, unusable, strict=True):
        bad |= (frame == saturation.level) & brighter
    fate = "masked, each in its own frame" if brighter.any() else "taken as air, for the flats are clipped too"
    text = "%s: %.3g %% of the projections' pixels are clipped at %g counts: %s"
    _log.warning(text, subject, 100 * saturation.share, saturation.level, fate)


def compact(mask: np.ndarray) -> Mask:
    """A mask (P, v, u) as (v, u) where all frames agree, and None where it marks nothing."""
    if not mask.any():
        return None
    if mask.all():
        expected = "frames brighter than the dark"
        raise InputError("pixels", "no usable value", expected, "check flats and darks")
    return mask[0] if all(np.array_equal(frame, mask[0]) for frame in mask) else mask


def oriented(array: np.ndarray, options: ImportOptions, row_0: str, column_0: str = "left") -> np.ndarray:
    """Frames or a mask (..., v, u) with row 0 the lowest and column 0 on the left, seen from the source; ``row_0`` and
    ``column_0`` are the format's custom, over which the options win."""
    if (options.row_0 or row_0) == "top":
        array = array[..., ::-1, :]
    if (options.column_0 or column_0) == "right":
        array = array[..., ::-1]
    return array


def _constant_flat(subject: str, frames: np.ndarray, options: ImportOptions) -> np.ndarray:
    if options.flat_value is None:
        remedy = f"add flat frames, or say {options.named('flat_value')}"
        raise InputError(f"{subject} flats", "none", "flat frames to divide counts by", remedy)
    return np.full((1, *frames.shape[1:]), options.flat_value, np.float32)
