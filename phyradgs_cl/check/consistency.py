"""Checks whether the frames fit together under the stated order, angles and geometry.

A coarse reconstruction of consistent frames leaves a far smaller residual than one of the same frames in a random order. If
it does not, or if another hypothesis leaves less than half the squared residual, something stated is wrong. The steps:
remove odd frames; take at most 60 of the others; choose the sense of rotation and the panel's shift (``orbit.py`` reports
them); remove outliers; compare with random orders; try hypotheses; compare all other frames with the volume of the 60."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import has_opposite_views, start_azimuths_rad, wrapped
from phyradgs_cl.acquisition.altered.coarse import MOST_FRAMES, some_frames, spread_evenly
from phyradgs_cl.acquisition.altered.variants import altered_trajectory, reversed_rotation, shifted
from phyradgs_cl.check import hypotheses
from phyradgs_cl.check.finding import CANNOT_TELL, FEWEST_COLUMNS, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.hypotheses import Hypothesis, frame_number
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.detector import noise_level, robust_deviation
from phyradgs_cl.reconstructors.fits import axis
from phyradgs_cl.reconstructors.fits.residuals import Fit, fit, fit_squares, t_statistic
from phyradgs_cl.runtime import Runtime

CONSISTENCY = "consistency"
# Frames are consistent if (RMS residual) / (that in a random order) is at most this: correct scans have 0.02 to 0.23.
_LARGEST = 0.35
_RANDOM_ORDERS = 2  # number of random orders over which their squared residual is averaged
_FEWEST_FRAMES = 5  # fewer frames cannot tell one order from another
_FEWEST_PIXELS = 32  # fewer valid coarse pixels per frame cannot tell one order from another
_CLEAR = 0.5  # a hypothesis must leave less than this fraction of the stated scan's squared residual
_NEARLY = 1.5  # a rough fit is refined unless (its squared residual) / (least squared residual of rough fits) exceeds this
_ERRORS = 4.0  # a hypothesis's squared residual must be below the stated scan's by this many standard errors
# Limits of the RMS residual in a random order. Below either limit, the object looks the same from every angle.
_SAME = 0.03  # an object looks alike from all angles below this (residual in a random order) / (σ of line integrals)
_NOISY = 1.6  # an object looks alike from all angles below this (residual in a random order) / (noise): round ones had 1.3
# Noise explains an RMS residual below this fraction of the noise in the mean of a block's pixels: 0.33, because the frames
# are smoothed, and a fifth more for uneven noise.
_SMOOTHED = 0.4
_MOST_REFINED = 2  # only this many hypotheses, the best ones, get a refined shift of the panel, which takes time
_SHIFT_PENALTY = 1.5  # factor on a hypothesis's squared residual per coarse pixel of shift: stated offsets are mostly right
# An odd frame exceeds two limits of its change, which is |its mean line integral − median of its neighbours' means|.
_DEVIATIONS = 12.0  # least (change of an odd frame's mean line integral) / (robust standard deviation of all changes)
_LEAST_CHANGE = 0.75  # least (change of an odd frame's mean line integral) / |median of all frames' means|
_REPEATED = 0.15  # a frame repeats the last one if (its change) / (least change between frames nearby) is below this
_JUMP = 2.5  # an order jumps, as the golden angle does, if (its median step) / (median step of sorted angles) exceeds this
_UNLIKE = 2.0  # where an order jumps, least (RMS difference of a repeated frame from the next view in angle) / (its median)
_OUTLIER = 4.0  # least (RMS residual of an outlier) / (median RMS residual of the frames)
# Least (RMS residual of an outlier) / (that in a random order), and / (RMS difference of the outlier from the frames' mean):
# right frames, along a thin plate without noise, had up to 0.2; frames at 90 % of their contrast have at least 0.27.
_LEAST_OUTLIER = 0.22
_MOST_FITTED = 5 / 6  # of more than 60 frames, at most this fraction is fitted: the others need a median of their own
# Frames at both ends of an arc may fit badly if the ratio of their residuals is below this: right frames had 1.4, odd 2.3.
_ALIKE = 1.7
# Frames at both ends may fit badly only if (residual) / (that in a random order) is below this: right ones had 0.2, odd 0.3.
_AT_BOTH_ENDS = 0.25
_MOST_OUTLIERS = 0.2  # if this fraction of the frames or more are outliers, they have a common cause, and none is removed
_EXCHANGED = 0.5  # two frames were exchanged if their exchange leaves less than this fraction of their squared residuals


@dataclass(frozen=True, eq=False)
class Consistency:
    """The ``finding`` about whether frames fit together. frames (n,): indices of the frames that fit. is_sound: whether
    further questions can be answered. sees_angles: whether the object looks different from different angles."""

    finding: Finding
    frames: np.ndarray
    is_sound: bool
    sees_angles: bool


def check_consistency(rt: Runtime, scan: Scan, as_stated: Scan) -> Consistency:
    """Finds whether the frames of a coarse ``scan`` fit together, and else frames and hypotheses that explain why not.

    The finding's value is (RMS residual in the stated order) / (that in a random order). as_stated: the full scan. Both have
    all frames, and each is looked at. At most 60 of them, spread evenly, are fitted, and judge the others."""
    pixels = float(scan.valid.sum()) / scan.frames
    if scan.frames < _FEWEST_FRAMES or pixels < _FEWEST_PIXELS or scan.projections.shape[2] < FEWEST_COLUMNS:
        text = f"fewer than {_FEWEST_FRAMES} frames, {FEWEST_COLUMNS} columns or {_FEWEST_PIXELS} coarse pixels per frame"
        finding = Finding(CONSISTENCY, CANNOT_TELL, 0.0, _LARGEST, "share", text)
        return Consistency(finding, np.arange(scan.frames), False, False)
    right, notes = without_odd_frames(scan)
    most = MOST_FRAMES if len(right) <= MOST_FRAMES else min(MOST_FRAMES, int(_MOST_FITTED * len(right)))
    fitted = right[spread_evenly(len(right), most)]
    turned, best, rough_square = _best_sense(rt, some_frames(scan, fitted))
    random_total = _random_order(rt, best)
    remaining, stated = without_outliers(rt, best, fit(rt, best), random_total / best.frames)
    frames, outliers = fitted[remaining], np.delete(fitted, remaining)
    if outliers.size:
        turned, best = some_frames(turned, remaining), some_frames(best, remaining)
        random_total = _random_order(rt, best)
    ratio = float(np.sqrt(stated.total / max(random_total, 1e-30)))
    every = replace(scan, trajectory=replace(altered_trajectory(best), frames=altered_trajectory(scan).frame_numbers(scan)))

    def answer(verdict: str, text: str, advice: str, is_sound: bool, sees_angles: bool = True) -> Consistency:
        texts = [*notes, *_about_outliers(rt, every, stated, outliers), text]
        finding = Finding(CONSISTENCY, verdict, ratio, _LARGEST, "share", "; ".join(texts), advice)
        return Consistency(finding, frames, is_sound, sees_angles)

    def answer_about_frames(verdict: str, text: str, sees_angles: bool) -> Consistency:
        nonlocal outliers
        outliers = np.union1d(outliers, _misfits(rt, every, stated, np.setdiff1d(right, fitted), random_total / best.frames))
        if not notes and not outliers.size:
            return answer(verdict, text, "", True, sees_angles)
        advice = "exclude these frames (image_key 3), or correct them; further answers do not use them"
        return answer(SUSPICIOUS, text, advice, True, sees_angles)

    if ratio > _LARGEST and random_total <= best.frames * _unseen(best, as_stated) ** 2:
        text = "the frames differ too little from angle to angle: a wrong order or wrong angles would not show"
        return answer_about_frames(CANNOT_TELL, text, sees_angles=False)
    text = f"residual {ratio:.2g} of that of the frames in a random order"
    scans = some_frames(scan, frames), turned, best
    hypothesis = _explanation(rt, *scans, as_stated, stated, random_total, rough_square)
    if hypothesis is not None:
        return answer(SUSPICIOUS, hypothesis.text, hypothesis.advice, False)
    if hypotheses.stated_redundancy(as_stated) < 0:
        text = "detector_offset puts the axis of rotation beside the panel, where frames fit under any geometry"
        advice = "compare detector_offset and pixel sizes, and their units, with the scanner's log"
        return answer(SUSPICIOUS, text, advice, False)
    if ratio > _LARGEST and stated.total <= best.frames * (_SMOOTHED * _noises(best, as_stated)[1]) ** 2:
        text = f"the frames' noise leaves {ratio:.2g} of the residual of a random order: a wrong order would hardly show"
        return answer_about_frames(CANNOT_TELL, text, sees_angles=True)
    if ratio > _LARGEST:
        doubtful = "distances and pixel sizes, flats and the panel's tilt"
        if scan.is_parallel:
            doubtful = "flats and the panel's roll"
        advice = f"compare order and orientation of the frames, angles, {doubtful} with the scanner's log"
        return answer(SUSPICIOUS, f"frames do not fit together, cause not found: {text}", advice, False)
    return answer_about_frames(OK, text, sees_angles=True)


def _noises(scan: Scan, as_stated: Scan) -> tuple[float, float]:
    """Returns two estimates of the noise of coarse pixels: from themselves, and from the means of full pixels.

    scan: the coarse scan. as_stated: the full scan."""
    levels = [noise_level(one.projections, np.broadcast_to(one.valid, one.projections.shape)) for one in (scan, as_stated)]
    return levels[0], levels[1] / float(np.prod(altered_trajectory(scan).blocks)) ** 0.5


def _unseen(scan: Scan, as_stated: Scan) -> float:
    """Returns the RMS residual below which frames in a random order show that the object looks the same from every angle.

    scan: the coarse scan. as_stated: the full scan."""
    # The smaller of two estimates is taken: edges raise the one from coarse pixels, uneven noise the one from full pixels.
    return max(_SAME * float(np.asarray(scan.projections, np.float64).std()), _NOISY * min(_noises(scan, as_stated)))


def _best_sense(rt: Runtime, scan: Scan) -> tuple[Scan, Scan, float]:
    """Chooses another sense of rotation and panel shift if they leave less than half of the squared residual. A scan with
    opposite views keeps its sense: both senses fit it equally well.

    Returns the scan with the chosen sense, then with the shift too, and the mean squared residual of the best rough fit."""
    senses, limits_px = [scan], [axis.ANYWHERE]
    if not has_opposite_views(scan):
        senses, limits_px = [scan, reversed_rotation(scan)], [axis.ANYWHERE, hypotheses.shifts_for_sense_px(scan)]
    roughs = [axis.rough_shift(rt, sense, limits) for sense, limits in zip(senses, limits_px, strict=True)]
    least_rough = min(float(rough.squares.mean()) for rough in roughs)
    turned = best = scan
    least = _CLEAR * fit_squares(rt, scan).sum()
    for sense, rough, limits in zip(senses, roughs, limits_px, strict=True):
        if rough.squares.mean() > _NEARLY * least_rough:  # this sense of rotation fits clearly worse
            continue
        shift = axis.refined_shift(rt, sense, rough, limits)
        if not shift.is_found:
            continue
        other = shifted(sense, shift.pixels)
        if (squares := fit_squares(rt, other).sum()) < least:
            turned, best, least = sense, other, squares
    return turned, best, least_rough


def _random_order(rt: Runtime, scan: Scan) -> float:
    """Returns the sum of all frames' mean squared residuals if the frames are in a random order; a mean over two orders."""
    rng = np.random.default_rng(0)
    orders = [rng.permutation(scan.frames) for _ in range(_RANDOM_ORDERS)]
    return float(np.mean([fit_squares(rt, replace(scan, projections=scan.projections[order])).sum() for order in orders]))


def _explanation(
    rt: Runtime, scan: Scan, turned: Scan, best: Scan, as_stated: Scan, fitted: Fit, random_total: float, rough_square: float
) -> Hypothesis | None:
    """Returns the best hypothesis under which the frames are consistent, with less than half of the stated scan's squared
    residual; None without one. turned, best, rough_square: what ``_best_sense`` returns. fitted: the fit of ``best``.

    If the panel sees less than half of the rays twice, frames fit any geometry. Then the first hypothesis about sizes under
    which they are consistent is returned. Only without one, and if the panel sees the axis, all hypotheses are compared."""
    is_one_sided = hypotheses.stated_redundancy(as_stated) < hypotheses.LEAST_REDUNDANCY
    about_scan = _refined_hypotheses(rt, scan, as_stated, np.inf if is_one_sided else rough_square)
    for hypothesis in about_scan if is_one_sided else ():
        sized = hypothesis.scan()
        if hypothesis.factor != 1 and fit_squares(rt, sized).sum() < _LARGEST**2 * _random_order(rt, sized):
            return hypothesis
    if hypotheses.stated_redundancy(as_stated) < 0:
        return None
    candidates = chain(about_scan, hypotheses.of_frames(turned, best), _best_gaps(rt, turned, as_stated))
    return _best_below(rt, candidates, fitted, min(_CLEAR * fitted.total, _LARGEST**2 * random_total))


def _best_gaps(rt: Runtime, scan: Scan, as_stated: Scan) -> Iterator[Hypothesis]:
    """Yields the hypotheses that a frame is missing and that one is there twice, each at the place where it fits best. The
    place is sought in a quarter of the scan, then in an eighth, and so on, because frames on its wrong side fit badly."""
    for is_missing in (True, False):
        squares: dict[int, float] = {}
        at, step = scan.frames // 2, scan.frames // 4
        while step:
            for place in {at - step, at, at + step} - set(squares):
                squares[place] = fit_squares(rt, hypotheses.of_gap(scan, as_stated, place, is_missing).scan()).sum()
            at, step = min(squares, key=lambda place: squares[place]), step // 2
        yield hypotheses.of_gap(scan, as_stated, at, is_missing)


def _refined_hypotheses(rt: Runtime, scan: Scan, as_stated: Scan, most: float) -> list[Hypothesis]:
    """Returns up to two hypotheses about the whole scan, the best ones, with the panel shifted to fit best.

    most: hypotheses whose rough fit leaves over 1.5 times this mean squared residual are left out. The factor is not 1
    because an offset between two coarse pixels hides other differences. Large shifts count against a hypothesis. Of several
    hypotheses with the same factor of sizes, other than 1, only the best counts."""
    tried: list[tuple[Hypothesis, Scan, axis.AxisShift]] = []
    for hypothesis in hypotheses.of_scan(scan, as_stated):
        other = hypothesis.scan()
        tried.append((hypothesis, other, axis.rough_shift(rt, other)))
    block = axis.columns_per_block(scan)
    tried.sort(key=lambda one: one[2].squares.sum() * _SHIFT_PENALTY ** (abs(one[2].pixels) / block))
    factors: set[float] = set()
    distinct = []
    for hypothesis, other, rough in tried:
        if hypothesis.factor == 1 or hypothesis.factor not in factors:
            distinct.append((hypothesis, other, rough))
            factors.add(hypothesis.factor)
    refined = []
    for hypothesis, other, rough in distinct[:_MOST_REFINED]:
        if rough.squares.mean() < _NEARLY * most:
            shift = axis.refined_shift(rt, other, rough)
            pixels = shift.pixels if shift.is_found else rough.pixels
            refined.append(replace(hypothesis, scan=partial(shifted, other, pixels)))
    return refined


def _best_below(rt: Runtime, candidates: Iterable[Hypothesis], stated: Fit, most: float) -> Hypothesis | None:
    """Returns the candidate with the least squared residual, among those with less than ``most`` that are better than the
    fit ``stated`` by four standard errors; None if there is none."""
    best, least = None, most
    for hypothesis in candidates:
        squares = fit_squares(rt, hypothesis.scan())
        if squares.sum() < least and t_statistic(stated.squares, squares) <= -_ERRORS:
            best, least = hypothesis, float(squares.sum())
    return best


def without_odd_frames(scan: Scan) -> tuple[np.ndarray, list[str]]:
    """Finds odd and repeated frames before any reconstruction. Returns the indices (n,) of the frames that stay, and a note
    for each frame that is left out."""
    odd, repeated = odd_frames(scan.projections, scan.pixel_mask), repeated_frames(scan)
    notes = [f"frame {frame_number(scan, f)} is unlike all others (black, bright, or no image)" for f in odd]
    notes += [f"frame {frame_number(scan, f)} is frame {frame_number(scan, f - 1)} recorded twice" for f in repeated]
    return np.setdiff1d(np.arange(scan.frames), [*odd, *repeated]), notes


def odd_frames(p: np.ndarray, mask: np.ndarray | None) -> list[int]:
    """Returns the indices of the frames of line integrals p (F, v, u) whose mean is far from the means of the two frames
    before and after. mask (v, u) or (F, v, u): non-zero for pixels not to be used."""
    if len(p) < _FEWEST_FRAMES:
        return []
    valid = 1.0 if mask is None else (np.asarray(mask) == 0).astype(np.float32)
    weight = np.broadcast_to(valid, p.shape)
    level = (p * weight).sum((1, 2), dtype=np.float64) / np.maximum(weight.sum((1, 2)), 1)
    difference = level - np.median(_neighbours(level), axis=0)
    least = max(_DEVIATIONS * robust_deviation(difference), _LEAST_CHANGE * abs(float(np.median(level))))
    return [int(f) for f in np.flatnonzero(np.abs(difference) > least)]


def repeated_frames(scan: Scan) -> list[int]:
    """Returns the indices of frames that repeat their predecessor although the gantry has turned: they differ from it by
    less than 0.15 times the least change between frames nearby, apart from the level, because light may be uneven. In an
    order that jumps, such as the golden angle, distant views of a round object may look the same. In such an order a
    repeated frame must also differ from the next view in angle."""
    p = scan.projections
    if len(p) < _FEWEST_FRAMES:
        return []
    valid = np.broadcast_to(True if scan.pixel_mask is None else np.asarray(scan.pixel_mask) == 0, p.shape)

    def apart(one: int, other: int) -> float:
        seen = valid[one] & valid[other]
        return float(np.std((p[other] - p[one])[seen], dtype=np.float64)) if seen.any() else np.inf

    steps = np.array([apart(frame, frame + 1) for frame in range(len(p) - 1)])
    azimuths_rad = start_azimuths_rad(scan)
    turned_rad = np.abs(wrapped(np.diff(azimuths_rad)))
    alike = np.flatnonzero((turned_rad > 1e-6) & (steps < _REPEATED * np.min(_neighbours(steps), axis=0)))
    order = np.argsort(azimuths_rad % (2 * np.pi))
    beside = np.empty(len(p), int)
    beside[order] = np.roll(order, -1)
    jumps = np.median(turned_rad) > _JUMP * np.median(np.abs(wrapped(azimuths_rad[beside] - azimuths_rad)))
    if alike.size and jumps:
        from_beside = np.array([apart(frame, other) for frame, other in enumerate(beside.tolist())])
        alike = alike[from_beside[alike + 1] > _UNLIKE * np.median(from_beside)]
    return [int(f) + 1 for f in alike]


def _rms(image: np.ndarray) -> float:
    return float(np.square(image, dtype=np.float64).mean()) ** 0.5


def _neighbours(values: np.ndarray) -> np.ndarray:
    """Returns (4, F): for each of ``values`` (F,), the two values before and the two after it; at the ends, the four
    nearest. Of fewer than five values it returns all others."""
    at = np.arange(len(values))[:, None]
    near = np.clip(at - 2, 0, max(len(values) - 5, 0)) + np.arange(min(5, len(values)))
    return np.asarray(values[near[near != at].reshape(len(values), -1)].T)


def without_outliers(rt: Runtime, scan: Scan, stated: Fit, random_square: float) -> tuple[np.ndarray, Fit]:
    """Removes frames whose RMS residual is 4 times the median or more, the worst first, with a new fit after each.

    stated: the fit of all frames. random_square: the mean squared residual of frames in a random order. Returns the indices
    (n,) of the frames that stay, and their fit. If a fifth of the frames are outliers, they have a common cause, and none is
    removed."""
    remaining, current = np.arange(scan.frames), stated
    while scan.frames - len(remaining) < _MOST_OUTLIERS * scan.frames:
        size = np.sqrt(current.squares)
        is_outlier = _are_outliers(some_frames(scan, remaining), size, random_square**0.5)
        size[~is_outlier | _ends_alike(size, random_square**0.5)] = 0
        worst = int(np.argmax(size))
        if size[worst] == 0:
            return remaining, current
        remaining = np.delete(remaining, worst)
        current = fit(rt, some_frames(scan, remaining))
    return np.arange(scan.frames), stated


def _are_outliers(scan: Scan, residual: np.ndarray, random: float) -> np.ndarray:
    """Returns which frames are outliers, bool (F,). residual (F,): each frame's RMS residual. random: as for
    ``_ends_alike``. A frame that differs much from the others, as one along a plate does, may have a larger residual."""
    p = np.where(scan.valid, scan.projections, 0)
    differences = np.array([_rms(frame) for frame in p - p.mean(0)])
    return residual >= np.maximum(_OUTLIER * np.median(residual), _LEAST_OUTLIER * np.maximum(differences, random))


def _misfits(rt: Runtime, scan: Scan, fitted: Fit, left_out: np.ndarray, random_square: float) -> np.ndarray:
    """Returns which of the frames ``left_out`` (n,), indices of frames of ``scan``, are outliers by their residuals from the
    volume of other frames. random_square: as for ``without_outliers``."""
    if not left_out.size:
        return left_out
    groups = np.array_split(left_out, ceil_div(left_out.size, MOST_FRAMES))  # all at once would take much memory
    squares = np.concatenate([fitted.squares_of(rt, some_frames(scan, group)) for group in groups])
    return left_out[_are_outliers(some_frames(scan, left_out), np.sqrt(squares), random_square**0.5)]


def _about_outliers(rt: Runtime, scan: Scan, fitted: Fit, outliers: np.ndarray) -> list[str]:
    """Returns a note about the frames ``outliers`` (n,), indices of frames of ``scan``; none without. The note says if two
    outliers fit in exchanged order. fitted: the fit of frames without them."""
    if not outliers.size:
        return []
    numbers = [str(frame_number(scan, f)) for f in outliers]
    if len(outliers) == 2:
        pair = some_frames(scan, outliers)
        exchanged = replace(pair, projections=pair.projections[::-1])
        if fitted.squares_of(rt, exchanged).sum() < _EXCHANGED * fitted.squares_of(rt, pair).sum():
            return [f"frames {numbers[0]} and {numbers[1]} (from 0) fit if their order is exchanged"]
    frames, do = ("frames", "do") if len(outliers) > 1 else ("frame", "does")
    return [f"{frames} {', '.join(numbers)} (from 0) {do} not fit the others"]


def _ends_alike(residual: np.ndarray, random: float) -> np.ndarray:
    """Returns which first and last frames, bool (F,), fit about equally badly, as correct frames of an open arc do.

    Frames at an end have neighbours on one side only, so a few iterations fit them less well, and a slow drift shows in
    them. If they were removed, the frames next to them would be outliers. residual (F,): each frame's RMS residual. random:
    RMS residual in a random order."""
    is_apart = residual >= _OUTLIER * np.median(residual)
    at_an_end = np.logical_and.accumulate(is_apart) | np.logical_and.accumulate(is_apart[::-1])[::-1]
    return at_an_end & (residual < _ALIKE * residual[::-1]) & (residual < _AT_BOTH_ENDS * random)
