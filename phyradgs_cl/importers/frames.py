"""Raw frames of any origin to line integrals on an upright panel, with bad pixels masked."""

from __future__ import annotations

import numpy as np

from phyradgs_cl.detector import counts_to_attenuation
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.options import ImportOptions, option_name

Mask = np.ndarray | None


def line_integrals(
    culprit: str,
    frames: np.ndarray,
    options: ImportOptions,
    *,
    flats: np.ndarray | None = None,
    darks: np.ndarray | None = None,
    custom: str | None = None,
) -> tuple[np.ndarray, Mask]:
    """Line integrals (P, v, u) float32 of ``frames`` (P, v, u), and the pixels not to be used.

    Args:
        culprit: the file, for messages.
        frames: as stored, in any real type.
        options: its ``quantity`` wins over everything, its ``flat_value`` stands in for flats.
        flats, darks: (n, v, u) or None.
        custom: the quantity that the format, or the file, gives; None where nothing is said: then frames with
            flats are counts, and floats without any are refused.
    """
    quantity = options.quantity or custom or ("counts" if has_flats(flats, options) else None)
    if quantity is None:
        remedy = f"say {option_name('quantity')} attenuation, transmission or counts"
        raise InputError(f"{culprit} quantity", "nothing that says it", "what the pixels hold", remedy)
    stacks, keys = [frames], [np.zeros(len(frames), np.int64)]
    if quantity == "counts":
        if options.flat_value is not None or flats is None or len(flats) == 0:
            flats = _constant_flat(culprit, frames, options)
        for stack, key in ((flats, 1), (darks, 2)):
            if stack is not None and len(stack):
                _check_panel(culprit, stack, frames)
                stacks.append(stack)
                keys.append(np.full(len(stack), key))
    data = np.concatenate(stacks) if len(stacks) > 1 else frames
    integrals, unusable = counts_to_attenuation(data, np.concatenate(keys), quantity)
    return integrals, compact(unusable)


def has_flats(flats: np.ndarray | None, options: ImportOptions) -> bool:
    """Whether there is anything to divide counts by."""
    return (flats is not None and len(flats) > 0) or options.flat_value is not None


def compact(mask: np.ndarray) -> Mask:
    """A mask (P, v, u) as (v, u) where all frames agree, and None where it marks nothing."""
    if not mask.any():
        return None
    if mask.all():
        raise InputError(
            "pixels", "no usable value", "frames brighter than the dark", "check flats and darks"
        )
    return mask[0] if (mask == mask[:1]).all() else mask


def united(first: Mask, second: Mask) -> Mask:
    """Union of two masks, each (v, u), (P, v, u) or None."""
    if first is None or second is None:
        return second if first is None else first
    return first | second


def upright(array: np.ndarray, options: ImportOptions, row_0: str, column_0: str = "left") -> np.ndarray:
    """Frames or a mask (..., v, u) with row 0 the lowest and column 0 on the left, seen from the source.

    ``row_0`` and ``column_0`` are the format's custom; the options win.
    """
    if (options.row_0 or row_0) == "top":
        array = array[..., ::-1, :]
    if (options.column_0 or column_0) == "right":
        array = array[..., ::-1]
    return array


def _constant_flat(culprit: str, frames: np.ndarray, options: ImportOptions) -> np.ndarray:
    if options.flat_value is None:
        remedy = f"add flat frames, or say {option_name('flat_value')}"
        raise InputError(f"{culprit} flats", "none", "flat frames to divide counts by", remedy)
    return np.full((1, *frames.shape[1:]), options.flat_value, np.float32)


def _check_panel(culprit: str, stack: np.ndarray, frames: np.ndarray) -> None:
    if stack.shape[1:] != frames.shape[1:]:
        found = f"flats or darks of {stack.shape[1:]}"
        raise InputError(culprit, found, f"the projections' {frames.shape[1:]} pixels")
