"""Frames of any origin: turned to row 0 the lowest, converted to line integrals, bad pixels masked."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from phyradgs_cl.acquisition import Saturation
from phyradgs_cl.acquisition.scan import applied_facts
from phyradgs_cl.detector.attenuation import frames_to_attenuation
from phyradgs_cl.detector.noise_level import find_saturation
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.reading.flats import light_of
from phyradgs_cl.io.scan.reader import LARGEST_LINE_INTEGRAL

_log = logging.getLogger(__name__)
Mask = np.ndarray | None
TAKEN = "taken"
"""The key of the provenance for which frames and flats were taken, in words."""
_AIR = 0.2  # of a line integral beside the object, with noise
_SAME = 1e-3  # relative difference of a flat that is at the ceiling too


@dataclass(frozen=True, eq=False)
class LineIntegrals:
    """Line integrals (P, v, u) float32 with the mask of unusable pixels, the panel's saturation as raw counts show it,
    and the numbers of applied flats and darks as provenance."""

    values: np.ndarray
    mask: Mask
    saturation: Saturation | None = None
    applied: Mapping[str, object] = field(default_factory=dict)


def line_integrals(
    subject: str, frames: np.ndarray, options: ImportOptions, *, flats: np.ndarray | None = None,
    darks: np.ndarray | None = None, convention: str | None = None, is_corrected: bool = False,
    flats_at: np.ndarray | None = None, names: Mapping[str, Sequence[str]] | None = None,
) -> LineIntegrals:
    """Converts ``frames`` (P, v, u) of any real type to line integrals. Masks clipped counts and values that no object has,
    with a warning. ``subject`` names the file; ``flats``, ``darks``: (n, v, u) or None. The quantity is that of the options,
    else ``convention``, of the format or file; without either, frames with flats are counts and others are refused.
    ``is_corrected``: the scanner has subtracted the darks. ``flats_at``, ``names``: see ``flats.light_of``."""
    has_flats = flats is not None and len(flats) > 0
    quantity = options.quantity or convention or ("counts" if has_flats or options.flat_value is not None else None)
    if quantity is None:
        remedy = f"say {options.named('quantity')} attenuation, transmission or counts"
        raise InputError(f"{subject} quantity", "nothing that says it", "what the pixels hold", remedy)
    saturation = light = None
    if quantity != "counts":
        stacks = (("flats", flats), ("darks", darks))
        if unused := [f"{len(stack)} {name}" for name, stack in stacks if stack is not None and len(stack)]:
            _log.warning("%s: %s are left out, because the projections hold %s", subject, " and ".join(unused), quantity)
        flats = darks = None
    elif options.flat_value is not None:
        flats, has_flats = np.full((1, *frames.shape[1:]), options.flat_value, np.float32), False
    elif not has_flats:
        remedy = f"add flat frames, or say {options.named('flat_value')}"
        raise InputError(f"{subject} flats", "none", "flat frames to divide counts by", remedy)
    for stack in (flats, darks):
        if stack is not None and len(stack) and stack.shape[1:] != frames.shape[1:]:
            raise InputError(subject, f"flats or darks of {stack.shape[1:]}", f"the projections' {frames.shape[1:]} pixels")
    if flats is not None:
        with np.errstate(over="ignore", invalid="ignore"):
            light = light_of(subject, flats, darks, len(frames), options, flats_at, names)
            flat = light.flats.mean(axis=0)
            saturation = find_saturation(frames, flat)
        _refuse_logarithms(subject, frames, flat, options)
        if not is_corrected and (darks is None or len(darks) == 0):
            _log.warning("%s: counts without darks: an offset of the panel stays in the line integrals", subject)
    flats, darks, place = (light.flats, light.dark, light.place) if light else (None, None, None)
    integrals, unusable = frames_to_attenuation(frames, quantity, flats, darks, LARGEST_LINE_INTEGRAL, place)
    if quantity == "attenuation" and unusable.any():
        text = "%s: %d line integrals are not finite or beyond %g: masked"
        _log.warning(text, subject, np.count_nonzero(unusable), LARGEST_LINE_INTEGRAL)
    if saturation is not None and saturation.share > 0:
        air = "the flats are clipped too" if options.flat_value is None else f"{options.named('flat_value')} is no brighter"
        _mask_clipped(subject, frames, flat, saturation, unusable, air)
    flats_used, darks_used = light.used if light else (0, 0)
    applied = applied_facts(flats_used if has_flats else 0, darks_used)
    if light is not None and has_flats:
        applied[TAKEN] = light.said
    return LineIntegrals(integrals, compact(unusable), saturation, applied)


def _refuse_logarithms(subject: str, frames: np.ndarray, flat: np.ndarray, options: ImportOptions) -> None:
    """Raises InputError for line integrals with flats of ones: where counts are as bright as the flats, these are 0."""
    border = np.concatenate([frames[..., 0].ravel(), frames[..., -1].ravel()])
    if (flat == 1).all() and abs(float(np.median(border))) < _AIR:
        remedy = f"say {options.named('quantity')} attenuation, and leave the flats out"
        found = "flats of ones, and frames that are 0 at their borders"
        raise InputError(f"{subject} flats", found, "counts, which are as bright as the flats there", remedy)


def _mask_clipped(
    subject: str, frames: np.ndarray, flat: np.ndarray, saturation: Saturation, unusable: np.ndarray, air: str
) -> None:
    """Masks each frame's clipped pixels where the flat is brighter, since even air would read as an object there. Where the
    flat is clipped too, the integral is 0, which is right for air. Masking those pixels as well would leave no air, and the
    reconstruction would be 2 to 3 times further off than with thin parts lost. ``air``: why such pixels are air."""
    brighter = flat > saturation.level * (1 + _SAME)
    for frame, bad in zip(frames, unusable, strict=True):
        bad |= (frame == saturation.level) & brighter
    fate = "masked, each in its own frame" if brighter.any() else f"taken as air, for {air}"
    text = "%s: %.3g %% of the projections' pixels are clipped at %g counts: %s"
    _log.warning(text, subject, 100 * saturation.share, saturation.level, fate)


def compact(mask: np.ndarray) -> Mask:
    """Returns a mask (P, v, u) as (v, u) where all frames agree, and None where no pixel is masked."""
    if mask.all():
        raise InputError("pixels", "no usable value", "frames brighter than the dark", "check flats and darks")
    return None if not mask.any() else mask[0] if all(map(partial(np.array_equal, mask[0]), mask)) else mask


def oriented(array: np.ndarray, options: ImportOptions, row_0: str, column_0: str = "left") -> np.ndarray:
    """Returns frames or a mask (..., v, u) with row 0 the lowest and column 0 on the left, seen from the source. ``row_0``,
    ``column_0``: where the format has them, unless the options state it."""
    if (options.row_0 or row_0) == "top":
        array = array[..., ::-1, :]
    if (options.column_0 or column_0) == "right":
        array = array[..., ::-1]
    return array


def gantry_sign(options: ImportOptions, convention: str) -> float:
    """Returns +1 where stored angles are the gantry's, −1 where they are the sample's."""
    return 1.0 if (options.rotates or convention) == "gantry" else -1.0
