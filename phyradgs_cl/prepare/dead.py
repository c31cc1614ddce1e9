"""Dead and hot pixels and lines: those that say the same in every frame, or always something other than their neighbours."""

from dataclasses import dataclass

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.prepare.masked import with_masked
from phyradgs_cl.prepare.step import Facts, MakeModel

LEAST_FRAMES = 5
_DEVIATIONS = 10.0
_NORMAL_MAD = 1.4826
_MOST_TIMES = 0.7  # of the frames
_MOST_FRAMES = 40
_STILL_SIDES = 0.5  # of the outermost columns: from here air has no noise
_AROUND = np.ones((3, 3), bool)
_NEAR_AXIS = 1.5  # columns
_SHARED = 0.1  # of a pixel's distance, by its four neighbours: an object is never as sharp as a dead pixel
_LINE = 0.9  # of a line's pixels: from here the whole line is dead


@dataclass(frozen=True)
class DeadOptions:
    """deviations: least distance of a pixel from its neighbours, in those that are usual on the panel."""

    deviations: float = _DEVIATIONS

    def __post_init__(self) -> None:
        checks.within("dead.deviations", self.deviations, 1, 1e3)


def find_dead(
    frames: np.ndarray, *, deviations: float = _DEVIATIONS, axis_column: float | None = None
) -> np.ndarray:
    """Pixels (v, u) bool of line integrals (F, v, u) that are dead; none in fewer than five frames.

    Dead is a pixel that never changes while those around it do, or one beyond all its neighbours in 70 % of the frames, more
    than ``deviations`` of the panel's usual ones from the median of 3 × 3 pixels; near ``axis_column``, where small parts of
    the object stand still on the panel, it has to be sharper than these. A row or column that is beyond those beside it
    over nearly all its length is dead as a whole.
    """
    if len(frames) < LEAST_FRAMES:
        return np.zeros(frames.shape[1:], bool)
    chosen = np.unique(np.linspace(0, len(frames) - 1, _MOST_FRAMES).round().astype(int))
    some = np.asarray(frames)[chosen]
    still = np.zeros(frames.shape[2], bool)
    if axis_column is not None:
        still = np.abs(np.arange(frames.shape[2]) - axis_column) <= _NEAR_AXIS
    dead = _constant(some) | (_apart(some, deviations) & ~(_shared(some) & still))
    return dead | _lines(some, deviations)


def mask_dead(scan: Scan, options: DeadOptions, make_model: MakeModel) -> tuple[Scan, Facts]:
    """The scan with its dead pixels and lines masked and filled in."""
    found = find_dead(scan.projections, deviations=options.deviations, axis_column=axis_column(scan)) & scan.valid.any(0)
    lines = [int(np.count_nonzero(found.all(axis=axis))) for axis in (1, 0)]
    return with_masked(scan, found), {"pixels": int(found.sum()), "rows": lines[0], "columns": lines[1]}


def axis_column(scan: Scan) -> float:
    """The column, in pixels, that sees the axis of rotation in the first frame."""
    time_s = scan.frame_start_s[:1] + scan.shutter.middle_s
    source, corner, u, v = scan.trajectory.pose(0, time_s)[0].reshape(4, 3)
    return float(np.linalg.lstsq(np.stack([u, v, source], axis=1), source - corner, rcond=None)[0][0])


def _lines(frames: np.ndarray, deviations: float) -> np.ndarray:
    """Rows and columns (v, u) bool, whole: those beyond both lines beside them nearly everywhere, air included, in the
    median over the frames; no object is that long and thin."""
    dead = np.zeros(frames.shape[1:], bool)
    floor = 1e-3 * max(float(np.percentile(frames, 99.9)), 1e-9)
    for axis in (0, 1):
        lines = np.moveaxis(frames, axis + 1, 0)
        if len(lines) < 3:
            continue
        steps = np.diff(lines, axis=0)
        usual = _NORMAL_MAD * float(np.median(np.abs(np.median(steps, axis=1))))
        before, after = steps[:-1], -steps[1:]
        peak = np.where(before * after > 0, np.sign(before) * np.minimum(np.abs(before), np.abs(after)), 0)
        apart = np.abs(np.median(peak, axis=1)) > deviations * max(usual, floor)
        line = 1 + np.flatnonzero(apart.mean(axis=1) > _LINE)
        np.moveaxis(dead, axis, 0)[line] = True
    return dead


def _constant(frames: np.ndarray) -> np.ndarray:
    """Pixels that never change while those around them do; air without noise never changes either, and is no fault."""
    swing = np.ptp(frames, axis=0)
    constant = swing == 0
    sides = np.zeros_like(constant)
    sides[:, [0, -1]] = constant[:, [0, -1]]
    if sides[:, [0, -1]].mean() > _STILL_SIDES:
        level = float(np.median(frames[0][sides]))  # and what flats leave of a pattern about it
        pattern = _NORMAL_MAD * float(np.median(np.abs(frames[0][sides] - level)))
        air = constant & (np.abs(frames[0] - level) <= _DEVIATIONS * pattern)
        constant = constant & ~scipy.ndimage.binary_propagation(sides, _AROUND, mask=air)
    return constant & (scipy.ndimage.median_filter(swing, size=3) > 0)


def _apart(frames: np.ndarray, deviations: float) -> np.ndarray:
    """Pixels beyond all their neighbours in most frames, by far: edges of the object pass, or have neighbours alike."""
    ring = _AROUND.copy()
    ring[1, 1] = False
    above = np.mean([frame > scipy.ndimage.maximum_filter(frame, footprint=ring) for frame in frames], axis=0)
    below = np.mean([frame < scipy.ndimage.minimum_filter(frame, footprint=ring) for frame in frames], axis=0)
    apart = np.median([frame - scipy.ndimage.median_filter(frame, size=3) for frame in frames], axis=0)
    usual = _NORMAL_MAD * float(np.median(np.abs(apart - np.median(apart))))
    floor = 1e-3 * float(np.percentile(frames, 99.9))
    far = np.abs(apart - np.median(apart)) > deviations * max(usual, floor, 1e-12)
    return far & (np.maximum(above, below) > _MOST_TIMES)


def _shared(frames: np.ndarray) -> np.ndarray:
    """Pixels whose distance from the median of 5 × 5 their four neighbours share (one of which may be dead itself)."""
    apart = np.median([frame - scipy.ndimage.median_filter(frame, size=5) for frame in frames], axis=0)
    wide = np.pad(apart, 1, mode="edge")
    sides = np.median([wide[:-2, 1:-1], wide[2:, 1:-1], wide[1:-1, :-2], wide[1:-1, 2:]], axis=0)
    return sides * np.sign(apart) > _SHARED * np.abs(apart)
