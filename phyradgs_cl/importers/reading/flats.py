"""Flats and darks of a scan: those that do not fit the others, their medians, and flats over time.

Flats that were taken at several times of a scan, such as before and after it, are interpolated linearly in time. Frame
numbers are the time."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.options import ImportOptions

_log = logging.getLogger(__name__)
_PIXELS = 1 << 16  # looked at of a frame
_TOGETHER, _APART = 0.1, 0.3  # relative: how far flats of one time, and of several, may differ in brightness
_DARK = 0.02  # of the light: how far darks may differ
_PATTERN, _TIMES = 0.02, 5.0  # of the light; of the usual deviation: how far the pattern of a frame may differ
_BLOCK_BYTES = 1 << 26


@dataclass(frozen=True, eq=False)
class Light:
    """Flats (G, v, u) of G times, the dark (1, v, u) or None, and each projection's place (P,) among the times, 0.5 halfway
    from the first to the second. ``used``: how many flats and darks went in. ``said``: the same, in words."""

    flats: np.ndarray
    dark: np.ndarray | None
    place: np.ndarray
    used: tuple[int, int]
    said: str


def places(is_flat: np.ndarray, is_projection: np.ndarray) -> np.ndarray:
    """Returns the places of flats among the projections, from the kinds (F,) bool of frames in the order in which they were
    taken: −0.5 is before the first projection, 9.5 between numbers 9 and 10."""
    return np.cumsum(is_projection)[is_flat] - 0.5


def light_of(
    subject: str, flats: np.ndarray, darks: np.ndarray | None, count: int, options: ImportOptions,
    at: np.ndarray | None = None, names: Mapping[str, Sequence[str]] | None = None,
) -> Light:
    """Returns what divides ``count`` projections, from flats and darks (n, v, u). Of three or more, those that do not fit
    the others are named and left out. ``at`` (n,): places of the flats as of ``places``, None where nothing states them;
    ``names``: of single "flats" and "darks" in messages. InputError for the option flats "time" with flats of one time."""
    at, assumed = _times(subject, len(flats), count, options, at)
    light = max(float(np.median(_levels(flats)[1])), 1e-30)
    times = [np.flatnonzero(at == time) for time in np.unique(at)]
    said_by = (subject, light, names or {})
    times = [group[_fitting("flats", flats, group, _TOGETHER, *said_by)] for group in times]
    used = np.concatenate(times)
    if len(times) > 1:
        used = used[_fitting("flats", flats, used, _APART, *said_by)]
    times = [group for group in (np.intersect1d(group, used) for group in times) if len(group)]
    place = np.interp(np.arange(count), [at[group[0]] for group in times], np.arange(len(times)))
    medians = np.stack([median(flats[group]) for group in times])
    said = f"flats: {len(used)} of {len(times)} times, interpolated between them{assumed}"
    said = said if len(times) > 1 else f"flats: the median of {len(used)}"
    if darks is None or len(darks) == 0:
        return Light(medians, None, place, (len(used), 0), said)
    kept = darks[_fitting("darks", darks, np.arange(len(darks)), _DARK, *said_by)]
    return Light(medians, median(kept)[None], place, (len(used), len(kept)), f"{said}; darks: the median of {len(kept)}")


def median(stack: np.ndarray) -> np.ndarray:
    """Returns the median (v, u) float64 of frames (n, v, u), a block of rows at a time. A frame with NaN affects its pixel
    only."""
    rows = max(1, _BLOCK_BYTES // max(1, 8 * stack[:, 0].size))
    starts = range(0, stack.shape[1], rows)
    return np.concatenate([np.median(stack[:, start : start + rows].astype(np.float64), axis=0) for start in starts])


def _times(
    subject: str, flats: int, count: int, options: ImportOptions, at: np.ndarray | None
) -> tuple[np.ndarray, str]:
    """Returns the places (n,) of flats as the option says, and what was assumed, in words."""
    if options.flats != "time":
        return np.zeros(flats) if at is None or options.flats else at, ""
    if flats < 2 or (at is not None and np.ptp(at) == 0):
        found = f"{flats} of one time in {subject}"
        raise InputError(options.named("flats"), found, "flats of several times", "take their median: leave it out")
    before, said = (flats + 1) // 2, " (assumed: the first {} before the scan, the others after it)"
    return (np.repeat([-0.5, count - 0.5], [before, flats - before]), said.format(before)) if at is None else (at, "")


def _levels(stack: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns some pixels (n, k) of each frame, float64, those that are not finite as 0; and their medians (n,)."""
    pixels = stack.reshape(len(stack), -1)
    some = np.nan_to_num(pixels[:, :: -(-pixels.shape[1] // _PIXELS)].astype(np.float64), posinf=0.0, neginf=0.0)
    return some, np.median(some, axis=1)


def _fitting(
    kind: str, stack: np.ndarray, group: np.ndarray, tolerance: float, subject: str, light: float,
    names: Mapping[str, Sequence[str]],
) -> np.ndarray:
    """Returns which frames (k,) of a group of a stack fit the others, in their level and in their pattern; all of them where
    no majority says which ones are right. ``light``: counts of the flats. Warns of each that does not fit."""
    some, level = _levels(stack[group])
    usual = float(np.median(level))
    is_odd = np.abs(level - usual) > tolerance * light
    if tolerance != _APART:  # between several times the pattern of the beam may change
        if kind == "flats":
            some *= np.divide(usual, level, out=np.ones_like(level), where=level > 0)[:, None]
        pattern = np.abs(some - np.median(some, axis=0)).mean(axis=1)
        is_odd |= pattern > _TIMES * np.median(pattern) + _PATTERN * light
    if not is_odd.any():
        return ~is_odd
    called = names.get(kind) or [f"{kind} {i}" for i in range(len(stack))]
    if len(group) < 3 or 2 * is_odd.sum() >= len(group):
        text = "%s: %s are unlike each other (%.5g to %.5g counts) and are all used: take out the wrong ones"
        _log.warning(text, subject, ", ".join(called[i] for i in group[:6]), level.min(), level.max())
        return np.ones_like(is_odd)
    for i in np.flatnonzero(is_odd):
        text = "%s: %s is unlike the other %s (%.5g counts, they have %.5g): left out"
        _log.warning(text, subject, called[group[i]], kind, level[i], usual)
    return ~is_odd
