"""Do the frames fit together under what the file says of their order, angles and geometry?"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.coarse import some_frames
from phyradgs_cl.check.finding import CANNOT_TELL, FEWEST_COLUMNS, OK, SUSPICIOUS, Finding
from phyradgs_cl.check.frames import alike, odd_ones
from phyradgs_cl.check.hypotheses import (
    REDUNDANT,
    Cause,
    causes_of_frames,
    frame_number,
    stated_redundancy,
    whole_scans,
)
from phyradgs_cl.check.questions.offset import best_offset, block_of, rough_offset
from phyradgs_cl.check.residual import Fit, fit, fitted, system_of
from phyradgs_cl.check.statistics import t_statistic
from phyradgs_cl.check.variants import reversed_rotation, shifted
from phyradgs_cl.runtime import Runtime

_LARGEST = 0.35  # residual over that of the frames in a random order: right scans of every kind leave 0.02 to 0.23
_NEEDS_LOOK = 0.1
_DRAWS = 2
_FEWEST_FRAMES, _FEWEST_PIXELS = 5, 32
_CLEAR = 0.5  # squared residual of another order, step or size over the stated one's
_NEARLY = 1.5  # squared residual after few iterations over the least one's, up to which a sense of rotation is looked at
_ERRORS = 4.0
_SYMMETRIC = 2.0  # residual in a random order over the stated one's
_SAME = 0.03  # residual in a random order over the frames' own spread: less of both, and every angle looks alike
_MOST_WHOLE = 2  # hypotheses about the whole scan that are looked at closely
_PER_PIXEL = 1.5  # by which a coarse pixel of shift counts against a hypothesis: stated offsets are mostly right
_OUTLIER = 4.0  # residual of a frame over the usual one's
_MOST_OUTLIERS = 0.2  # of the frames
CONSISTENCY = "consistency"


@dataclass(frozen=True, eq=False)
class Consistency:
    """The finding; the frames (indices) that fit together; whether other questions can be asked of them; sees_angles:
    whether an object can be told from itself turned."""

    finding: Finding
    kept: np.ndarray
    is_sound: bool
    sees_angles: bool


def check_consistency(rt: Runtime, scan: Scan, as_stated: Scan) -> Consistency:
    """The residual of a coarse ``scan``, over that of its frames in a random order; and whatever explains them far
    better. Rotation and shift have questions of their own: the best of these is what other causes (an order or step of
    angles, sizes, distances, images the other way round) have to halve. Frames that stand out are left out first.
    ``as_stated``: the scan that the coarse one was made of."""
    everything = np.arange(scan.frames)
    pixels = float(scan.valid.sum()) / scan.frames
    if scan.frames < _FEWEST_FRAMES or pixels < _FEWEST_PIXELS or scan.projections.shape[2] < FEWEST_COLUMNS:
        text = f"fewer than {_FEWEST_FRAMES} frames, {FEWEST_COLUMNS} columns or {_FEWEST_PIXELS} coarse pixels per frame"
        return Consistency(_finding(CANNOT_TELL, 0.0, text, ""), everything, False, False)
    kept, notes = _without_odd(scan)
    unshifted, part, rough = _best_turning(rt, some_frames(scan, kept))
    stated = fit(system_of(rt, part))
    left, part, stated, more = _without_outliers(rt, part, stated)
    kept, unshifted, notes = kept[left], some_frames(unshifted, left), notes + more
    spread = float(np.asarray(part.projections, np.float64).var()) * part.frames
    random = _random(rt, part)
    share = float(np.sqrt(stated.total / max(random, 1e-30)))
    sees_angles = share * _SYMMETRIC < 1 or random > _SAME**2 * spread
    text = f"residual {share:.2g} of that of the frames in a random order"
    if not sees_angles:
        text = "the frames look the same from every angle: their order and angles leave no trace"
        verdict = SUSPICIOUS if notes else CANNOT_TELL
        finding = _finding(verdict, share, "; ".join([*notes, text]), _about(notes))
        return Consistency(finding, kept, True, False)
    most = min(_CLEAR * stated.total, _LARGEST**2 * random)
    one_sided = stated_redundancy(as_stated) < REDUNDANT
    whole = _whole(rt, some_frames(scan, kept), as_stated, np.inf if one_sided else rough)
    if one_sided and (cause := _fitting(rt, whole)) is not None:
        return Consistency(_finding(SUSPICIOUS, share, "; ".join([*notes, cause.text]), cause.advice), kept, False, True)
    if one_sided and stated_redundancy(as_stated) < 0:
        text = "detector_offset puts the axis of rotation beside the panel, where frames fit under any geometry"
        advice = "compare detector_offset and pixel sizes, and their units, with the scanner's log"
        return Consistency(_finding(SUSPICIOUS, share, "; ".join([*notes, text]), advice), kept, False, True)
    causes = chain(whole, causes_of_frames(unshifted, part, looks_closely=share > _NEEDS_LOOK))
    cause = _cause(rt, causes, stated, most)
    if cause is not None:
        finding = _finding(SUSPICIOUS, share, "; ".join([*notes, cause.text]), cause.advice)
        return Consistency(finding, kept, False, True)
    if share > _LARGEST:
        text = f"frames do not fit together, cause not found: {text}"
        advice = "compare order, angles, distances and pixel sizes, flats and the panel's tilt with the scanner's log"
        return Consistency(_finding(SUSPICIOUS, share, "; ".join([*notes, text]), advice), kept, False, True)
    finding = _finding(SUSPICIOUS if notes else OK, share, "; ".join([*notes, text]), _about(notes))
    return Consistency(finding, kept, True, True)


def _finding(verdict: str, share: float, text: str, advice: str) -> Finding:
    return Finding(CONSISTENCY, verdict, share, _LARGEST, "share", text, advice)


def _about(notes: list[str]) -> str:
    if not notes:
        return ""
    return "leave these frames out (image_key 3), or set them right; the other questions were asked without them"


def _without_odd(scan: Scan) -> tuple[np.ndarray, list[str]]:
    """(frames that do not stand out by themselves, what was said of the others)."""
    odd, twice = odd_ones(scan.projections, scan.pixel_mask), alike(scan)
    notes = [f"frame {frame_number(scan, f)} is unlike all others (black, bright, or no image)" for f in odd]
    notes += [f"frame {frame_number(scan, f)} is frame {frame_number(scan, f - 1)} recorded twice" for f in twice]
    return np.setdiff1d(np.arange(scan.frames), [*odd, *twice]), notes


def _best_turning(rt: Runtime, scan: Scan) -> tuple[Scan, Scan, float]:
    """The scan as it is, or turned the other way where that leaves far less; the same with its panel shifted, likewise; the
    mean squared residual after the few iterations of ``rough_offset``."""
    ways = [scan, reversed_rotation(scan)]
    roughs = [rough_offset(rt, way) for way in ways]
    least = min(float(rough.residuals.mean()) for rough in roughs)
    best, left = (scan, scan), _CLEAR * fitted(rt, scan).sum()
    for way, rough in zip(ways, roughs, strict=True):
        if rough.residuals.mean() > _NEARLY * least:  # in a narrow fan few iterations do not tell the two apart
            continue
        offset = best_offset(rt, way, rough)
        other = shifted(way, offset.pixels if np.isfinite(offset.pixels) else 0.0)
        if np.isfinite(offset.pixels) and (squares := fitted(rt, other).sum()) < left:
            best, left = (way, other), squares
    return *best, least


def _whole(rt: Runtime, scan: Scan, as_stated: Scan, rough: float) -> list[Cause]:
    """The best two hypotheses about the whole scan, with their panel shifted: of those that fit better than ``rough`` after
    few iterations."""
    tried = [(cause, cause.scan()) for cause in whole_scans(scan, as_stated)]
    offsets = [rough_offset(rt, other) for _, other in tried]
    moved = [abs(offset.pixels) / block_of(scan) for offset in offsets]
    rank = np.argsort([o.residuals.sum() * _PER_PIXEL**m for o, m in zip(offsets, moved, strict=True)])
    best: list[int] = []
    for number in rank:  # of one factor the one that moves the panel less
        if tried[number][0].factor == 1 or all(tried[number][0].factor != tried[n][0].factor for n in best):
            best.append(int(number))
    found = []
    for number in best[:_MOST_WHOLE]:
        (cause, other), offset = tried[number], offsets[number]
        if offset.residuals.mean() < rough:
            pixels = best_offset(rt, other, offset).pixels
            found.append(replace(cause, scan=partial(shifted, other, pixels if np.isfinite(pixels) else offset.pixels)))
    return found


def _random(rt: Runtime, scan: Scan) -> float:
    """The sum of squared residuals of the scan's frames in a random order."""
    rng = np.random.default_rng(0)
    orders = [rng.permutation(scan.frames) for _ in range(_DRAWS)]
    return float(np.mean([fitted(rt, replace(scan, projections=scan.projections[order])).sum() for order in orders]))


def _fitting(rt: Runtime, causes: Iterable[Cause]) -> Cause | None:
    """The first other size under which frames fit together by themselves, whatever they leave as stated."""
    for cause in causes:
        scan = cause.scan()
        if cause.factor != 1 and fitted(rt, scan).sum() < _LARGEST**2 * _random(rt, scan):
            return cause
    return None


def _without_outliers(rt: Runtime, scan: Scan, stated: Fit) -> tuple[np.ndarray, Scan, Fit, list[str]]:
    """(frames (indices) without those whose residual is far above the others', the scan of them, its fit, what to say).
    The worst goes first; where one in five would go, it is something that all share."""
    everything = left = np.arange(scan.frames)
    current = stated
    out: list[int] = []
    while len(out) < _MOST_OUTLIERS * scan.frames:
        size = np.sqrt(current.squares)
        worst = int(np.argmax(size))
        if size[worst] < _OUTLIER * np.median(size):
            break
        out.append(int(left[worst]))
        left = np.delete(left, worst)
        current = fit(system_of(rt, some_frames(scan, left)))
    if not out or len(out) >= _MOST_OUTLIERS * scan.frames:
        return everything, scan, stated, []
    part = some_frames(scan, left)
    names = [frame_number(scan, f) for f in out]
    note = f"frame{'s' if len(out) > 1 else ''} {', '.join(map(str, sorted(names)))} (from 0) do not fit the others"
    order = np.arange(scan.frames)
    order[out] = order[out[::-1]]
    exchanged = replace(scan, projections=scan.projections[order])
    if len(out) == 2 and fitted(rt, exchanged).sum() < _CLEAR * stated.total:
        note = f"frames {min(names)} and {max(names)} (from 0) fit if their order is exchanged"
    return left, part, current, [note]


def _cause(rt: Runtime, causes: Iterable[Cause], stated: Fit, most: float) -> Cause | None:
    """What explains the frames best, where its squared residual is below ``most``: of frames that then fit together."""
    best, least = None, most
    for cause in causes:
        squares = fitted(rt, cause.scan())
        if squares.sum() < least and t_statistic(stated.squares, squares) <= -_ERRORS:
            best, least = cause, float(squares.sum())
    return best
