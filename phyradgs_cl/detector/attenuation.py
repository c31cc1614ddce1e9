"""From what a detector records to line integrals, with its flat and dark frames."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import one_of, shape
from phyradgs_cl.errors import InputError

PROJECTION, FLAT, DARK, INVALID = 0, 1, 2, 3  # NXtomo's image_key
QUANTITIES = ("attenuation", "transmission", "counts")
# Transmission is kept at or above this before the logarithm (a line integral of 13.8): beyond what
# 16-bit detectors resolve, and finite.
TRANSMISSION_FLOOR = 1e-6
_LARGEST = float(np.finfo(np.float32).max)
_BLOCK = 1 << 18  # pixels that are converted at a time


def counts_to_attenuation(
    data: ArrayLike, image_key: ArrayLike, quantity: str
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Line integrals of the projections of a scan: data (F, v, u), integers or floats.

    "counts" become (I - dark) / (flat - dark) with the mean flat and dark (0 where there are none), "transmission" T
    becomes -ln T, "attenuation" stays. Frames whose key is not 0 are left out; image_key (F,): 0 projection, 1 flat, 2 dark,
    3 invalid. Returns (P, v, u) float32, in order and always finite; and a bool mask of the same shape, True where a value
    must not be used: not finite, a flat that is not brighter than the dark, a transmission at or below `TRANSMISSION_FLOOR`.
    InputError: shapes, keys or quantity wrong, no projection, or counts without a flat frame.
    """
    one_of("quantity", quantity, QUANTITIES)
    frames, key = np.asarray(data), np.asarray(image_key)
    shape("data", frames, (None, None, None))
    shape("image_key", key, (frames.shape[0],))
    _check_keys(key)
    return _converted(frames, np.flatnonzero(key == PROJECTION), quantity, frames[key == FLAT], frames[key == DARK])


def frames_to_attenuation(
    frames: NDArray[np.generic],
    quantity: str,
    flats: NDArray[np.generic] | None = None,
    darks: NDArray[np.generic] | None = None,
    largest: float = _LARGEST,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """``counts_to_attenuation`` of projections (P, v, u), with flats and darks (n, v, u) in arrays of their own;
    attenuation above ``largest`` must not be used either."""
    return _converted(frames, range(len(frames)), quantity, flats, darks, largest)


def _converted(
    frames: NDArray[np.generic],
    chosen: Sequence[int] | NDArray[np.intp],
    quantity: str,
    flats: NDArray[np.generic] | None,
    darks: NDArray[np.generic] | None,
    largest: float = _LARGEST,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    panel = frames.shape[1:]
    result = np.empty((len(chosen), *panel), dtype=np.float32)
    unusable = np.empty(result.shape, dtype=bool)
    rows = max(1, _BLOCK // max(1, panel[1]))
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is marked as unusable
        plain = np.broadcast_to(0.0, panel), np.broadcast_to(1.0, panel)
        dark, gain = _calibration(flats, darks) if quantity == "counts" else plain
        for i, frame in enumerate(chosen):
            for start in range(0, panel[0], rows):  # float64 copies of a scan, or of one huge frame, are large
                part = slice(start, start + rows)
                values = frames[frame, part].astype(np.float64)
                if quantity == "attenuation":
                    bad = ~(np.abs(values) <= largest)  # NaN compares false
                    result[i, part], unusable[i, part] = np.where(bad, 0.0, values), bad
                else:
                    result[i, part], unusable[i, part] = _minus_log(values - dark[part], gain[part])
    return result, unusable


def _check_keys(key: NDArray[np.generic]) -> None:
    unknown = sorted({int(k) for k in key} - {PROJECTION, FLAT, DARK, INVALID})
    if unknown:
        raise InputError("image_key", str(unknown), "0 projection, 1 flat, 2 dark, 3 invalid")
    if not (key == PROJECTION).any():
        raise InputError("image_key", "no projection (key 0)", "at least one projection")


def _calibration(
    flats: NDArray[np.generic] | None, darks: NDArray[np.generic] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean dark and mean flat minus dark, each (v, u); frames with NaN spoil their pixel only."""
    if flats is None or len(flats) == 0:
        remedy = "add flat frames, or store transmission or attenuation"
        raise InputError("image_key", "no flat (key 1) among counts", "at least one flat frame", remedy)
    flat = flats.mean(axis=0, dtype=np.float64)
    dark = np.zeros(flat.shape) if darks is None or len(darks) == 0 else darks.mean(axis=0, dtype=np.float64)
    return dark, flat - dark


def _minus_log(
    signal: NDArray[np.float64], gain: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    live = np.isfinite(signal) & np.isfinite(gain) & (gain > 0)
    transmission = np.divide(signal, gain, out=np.zeros_like(signal), where=live)
    p = -np.log(np.maximum(transmission, TRANSMISSION_FLOOR))
    unusable = ~live | (transmission <= TRANSMISSION_FLOOR) | ~np.isfinite(transmission)
    # A pixel without gain knows nothing: 0, not a wall. One that is merely dark keeps the floor's value.
    return np.where(live & np.isfinite(p), p, 0.0), unusable
