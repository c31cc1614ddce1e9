"""Converts frames of any format to line integrals, with row 0 the lowest and bad pixels masked. Flats and darks that are
unlike most are left out; the median of the rest is used.

Flats of several times, such as before and after the scan, are interpolated linearly in time, or over the frames' numbers
where nothing states the times."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from phyradgs_cl.acquisition import Saturation
from phyradgs_cl.acquisition.plausible import FEW
from phyradgs_cl.acquisition.scan import applied_facts
from phyradgs_cl.detector.attenuation import flats_by_time, frames_to_attenuation
from phyradgs_cl.detector.noise_level import find_saturation
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.io.scan.reader import LARGEST_LINE_INTEGRAL

_log = logging.getLogger(__name__)
_PIXELS = 1 << 16  # largest number of a frame's pixels that are compared with other frames': more would show little

# A flat or dark is left out if |its median − the median of all| exceeds this fraction of the flats' median.
_TOGETHER = 0.1  # largest relative difference of medians among flats of one time, in which the tube hardly drifts
_APART = 0.3  # largest relative difference of medians among flats of several times, between which the tube may drift
_DARK = 0.02  # largest difference of medians among darks, as a fraction of the flats' median

# A flat or dark is also left out if its pixels' mean difference from the others exceeds the sum of the next two limits.
_PATTERN = 0.02  # first part of a frame's allowed mean difference of pixels: this × the flats' median
_TIMES = 5.0  # second part of a frame's allowed mean difference of pixels: this × its median over all frames
_BLOCK_BYTES = 1 << 26  # bytes of the rows whose median is computed at once: a float64 copy of all frames would be large
Mask = np.ndarray | None
Moments = tuple[np.ndarray, np.ndarray]
"""When flats (n,) and projections (P,) were taken, both in one unit: their times, or places in the order of the frames."""
TAKEN = "taken"
"""The provenance's key of a text that says which frames and flats were used."""
_AIR = 0.2  # frames show air at their borders if |median line integral| or |median transmission − 1| is below this
_DIVIDED, _MANY_COUNTS = 2.0, 1000.0  # frames of values up to 2, with air at 1000 counts or more, are already divided by air
_SAME = 1e-3  # flats at most this fraction above the saturation level count as clipped


@dataclass(frozen=True, eq=False)
class Light:
    """Flats (G, v, u) at G times, and the dark (1, v, u) or None. place (P,): each projection's place among the flats, where
    0.5 is halfway from flat 0 to flat 1. used: how many flats and darks were used. said: a text about flats and darks."""

    flats: np.ndarray
    dark: np.ndarray | None
    place: np.ndarray
    used: tuple[int, int]
    said: str


def light_of(
    subject: str, flats: np.ndarray, darks: np.ndarray | None, count: int, options: ImportOptions,
    at: Moments | None = None, names: Mapping[str, Sequence[str]] | None = None,
) -> Light:
    """Returns the flats and dark for ``count`` projections, from flats and darks (n, v, u). Of three or more, those that do
    not fit the others are left out, with a warning. at: None if not stated. Flats without a projection between them are of
    one time. names: what messages call the single "flats" and "darks". Raises InputError for the option flats "time" with
    flats of one time."""
    flats_at, when, assumed = _times(subject, len(flats), count, options, at)
    light = max(float(np.median(_levels(flats)[1])), 1e-30)
    said_by = (subject, light, names or {})
    times = [
        group[_fitting("flats", flats, group, _TOGETHER, *said_by)] for group in flats_by_time(flats_at, when)
    ]
    used = np.concatenate(times)
    if len(times) > 1:
        used = used[_fitting("flats", flats, used, _APART, *said_by)]
    times = [group for group in (np.intersect1d(group, used) for group in times) if len(group)]
    place = np.interp(when, [np.median(flats_at[group]) for group in times], np.arange(len(times)))
    medians = np.stack([median(flats[group]) for group in times])
    said = f"flats: {len(used)} of {len(times)} times, interpolated between them{assumed}"
    said = said if len(times) > 1 else f"flats: the median of {len(used)}"
    if darks is None or len(darks) == 0:
        return Light(medians, None, place, (len(used), 0), said)
    kept = darks[_fitting("darks", darks, np.arange(len(darks)), _DARK, *said_by)]
    return Light(medians, median(kept)[None], place, (len(used), len(kept)), f"{said}; darks: the median of {len(kept)}")


def median(stack: np.ndarray) -> np.ndarray:
    """Returns the median (v, u) float64 of frames (n, v, u). It is NaN at pixels where a frame is NaN, and only there."""
    rows = max(1, _BLOCK_BYTES // max(1, 8 * stack[:, 0].size))
    starts = range(0, stack.shape[1], rows)
    return np.concatenate([np.median(stack[:, start : start + rows].astype(np.float64), axis=0) for start in starts])


def _times(
    subject: str, flats: int, count: int, options: ImportOptions, at: Moments | None
) -> tuple[np.ndarray, np.ndarray, str]:
    """Returns when n flats (n,) and the ``count`` projections were taken, and a text about assumed moments."""
    numbers = np.arange(count)
    if options.flats != "time":
        return (np.full(flats, -0.5), numbers, "") if at is None or options.flats else (*at, "")
    if flats < 2 or (at is not None and len(flats_by_time(*at)) == 1):
        found = f"{flats} of one time in {subject}"
        raise InputError(options.named("flats"), found, "flats of several times", "take their median: leave it out")
    before, said = (flats + 1) // 2, " (assumed: the first {} before the scan, the others after it)"
    if at is not None:
        return *at, ""
    return np.repeat([-0.5, count - 0.5], [before, flats - before]), numbers, said.format(before)


def _levels(stack: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns k evenly spaced pixels of n frames, (n, k) float64, and each frame's median (n,). NaN and infinity are 0."""
    pixels = stack.reshape(len(stack), -1)
    some = np.nan_to_num(pixels[:, :: -(-pixels.shape[1] // _PIXELS)].astype(np.float64), posinf=0.0, neginf=0.0)
    return some, np.median(some, axis=1)


def _fitting(
    kind: str, stack: np.ndarray, group: np.ndarray, tolerance: float, subject: str, light: float,
    names: Mapping[str, Sequence[str]],
) -> np.ndarray:
    """Returns which of k flats or darks, bool (k,), are like most of them in median and pattern. group (k,): their indices
    in ``stack`` (n, v, u). tolerance: largest difference of medians, as a fraction of ``light``, the flats' median counts.
    kind ("flats" or "darks"), subject, names: words of messages. Keeps all if k < 3 or at least half are unlike. Warns of
    each frame that it leaves out."""
    some, level = _levels(stack[group])
    usual = float(np.median(level))
    is_odd = np.abs(level - usual) > tolerance * light
    if tolerance != _APART:  # not for flats of several times, in which the beam's pattern may change
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


@dataclass(frozen=True, eq=False)
class LineIntegrals:
    """Line integrals (P, v, u) float32 and the mask of unusable pixels: (v, u), (P, v, u) or None. saturation: how raw
    counts were clipped, or None. applied: entries about flats and darks for the provenance."""

    values: np.ndarray
    mask: Mask
    saturation: Saturation | None = None
    applied: Mapping[str, object] = field(default_factory=dict)

    def in_light(self, light: np.ndarray) -> "LineIntegrals":
        """Returns the line integrals of projections in ``light`` (P,) times the light of the flats."""
        return replace(self, values=self.values + np.float32(np.log(light))[:, None, None])


def line_integrals(
    subject: str, frames: np.ndarray, options: ImportOptions, *, flats: np.ndarray | None = None,
    darks: np.ndarray | None = None, convention: str | None = None, is_corrected: bool = False,
    flats_at: Moments | None = None, names: Mapping[str, Sequence[str]] | None = None,
) -> LineIntegrals:
    """Converts ``frames`` (P, v, u) of any real type to line integrals. Masks clipped counts and values that no object
    can have, with a warning.

    - subject: names the file. flats, darks: (n, v, u) or None. flats_at, names: see ``at``, ``names`` of ``light_of``.
    - convention: the quantity of the format or file; the options' comes first. Without both, frames with flats or a flat
      value are counts. is_corrected: the scanner has subtracted the darks.

    Raises InputError for a quantity that nothing states, counts without flats, flats or darks of another size, frames that
    cannot be counts beside such flats, and frames without a usable pixel."""
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
            _refuse_no_counts(subject, frames, flat, options)
        if not is_corrected and (darks is None or len(darks) == 0):
            _log.warning("%s: counts without darks: an offset of the panel stays in the line integrals", subject)
    if quantity == "attenuation":
        _warn_of_transmission(subject, frames, options)
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


def _warn_of_transmission(subject: str, frames: np.ndarray, options: ImportOptions) -> None:
    """Warns of frames (P, v, u) that look like transmissions: near 1 at the left and right borders, hardly a pixel above,
    and at least one pixel clearly below."""
    with np.errstate(over="ignore"):
        border = float(np.median(frames[..., [0, -1]]))
    brighter = sum(np.count_nonzero(frame > 1 + _AIR) for frame in frames)
    if abs(border - 1) < _AIR and brighter < FEW * frames.size and np.min(frames) < 1 - _AIR:
        text = "%s: 1 at their borders, and less within: are they transmissions? Say %s transmission"
        _log.warning(text, subject, options.named("quantity"))


def _refuse_no_counts(subject: str, frames: np.ndarray, flat: np.ndarray, options: ImportOptions) -> None:
    """Raises InputError for line integrals: the flat is 1 everywhere, and frames are near 0 at their left and right borders.
    Raises it for transmissions: floats of at most 2 in 99 % of the pixels, while air has 1000 counts or more."""
    air, may_be = float(np.median(flat)), frames.dtype.kind == "f"
    if may_be and air >= _MANY_COUNTS and sum(map(np.count_nonzero, (f > _DIVIDED for f in frames))) <= FEW * frames.size:
        found = f"fractions, at most {_DIVIDED:g}, and air at {air:g} counts"
        remedy = f"were they divided by the air already? Say {options.named('quantity')} transmission, or attenuation"
        raise InputError(f"{subject} quantity", found, "counts that reach those of air", remedy)
    border = np.concatenate([frames[..., 0].ravel(), frames[..., -1].ravel()])
    if (flat == 1).all() and abs(float(np.median(border))) < _AIR:
        remedy = f"say {options.named('quantity')} attenuation, and leave the flats out"
        found = "flats of ones, and frames that are 0 at their borders"
        raise InputError(f"{subject} flats", found, "counts, which are as bright as the flats there", remedy)


def _mask_clipped(
    subject: str, frames: np.ndarray, flat: np.ndarray, saturation: Saturation, unusable: np.ndarray, air: str
) -> None:
    """Sets ``unusable`` (P, v, u) at clipped pixels where the flat is brighter: even air would look like an object there.
    air: the reason why other clipped pixels count as air, as a text.

    Where the flat is clipped too, the integral becomes 0, which is right for air and loses thin parts of the object. Masking
    these pixels would leave no air, and made the reconstruction's error 2 to 3 times as large."""
    brighter = flat > saturation.level * (1 + _SAME)
    for frame, bad in zip(frames, unusable, strict=True):
        bad |= (frame == saturation.level) & brighter
    fate = "masked, each in its own frame" if brighter.any() else f"taken as air, for {air}"
    text = "%s: %.3g %% of the projections' pixels are clipped at %g counts: %s"
    _log.warning(text, subject, 100 * saturation.share, saturation.level, fate)


def compact(mask: np.ndarray) -> Mask:
    """Returns a mask (P, v, u) in its smallest form: (v, u) if all frames agree, None if nothing is masked. Raises
    InputError if everything is masked."""
    if mask.all():
        raise InputError("pixels", "no usable value", "frames brighter than the dark", "check flats and darks")
    return None if not mask.any() else mask[0] if all(map(partial(np.array_equal, mask[0]), mask)) else mask


def oriented(array: np.ndarray, options: ImportOptions, row_0: str, column_0: str = "left") -> np.ndarray:
    """Flips frames or masks (..., v, u) so that row 0 is the lowest and column 0 on the left, seen from the source. row_0,
    column_0: the sides on which the format stores them, such as "top"; the options' values come first."""
    if (options.row_0 or row_0) == "top":
        array = array[..., ::-1, :]
    if (options.column_0 or column_0) == "right":
        array = array[..., ::-1]
    return array
