"""Are there pixels that say the same in every frame, or always something other than their neighbours?"""

import numpy as np
import scipy

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.check.finding import CANNOT_TELL, OK, SUSPICIOUS, Finding

_DEVIATIONS = 10.0
_NORMAL_MAD = 1.4826
_SHARE = 2e-4  # of the panel's pixels
_LEAST_FRAMES = 5
_MOST_TIMES = 0.7  # of the frames
_MOST_FRAMES = 40
_STILL_SIDES = 0.5  # of the outermost columns: from here air has no noise
_AROUND = np.ones((3, 3), bool)
_NEAR_AXIS = 1.5  # columns
_SHARED = 0.1  # of a pixel's distance, by its four neighbours: an object is never as sharp as a dead pixel
_QUESTION = "dead pixels"


def check_dead_pixels(scan: Scan) -> tuple[Finding, np.ndarray]:
    """The share of pixels that are dead and not masked, against 0.02 %; and where they are (v, u) bool.

    Dead is a pixel that never changes while those around it do, or one beyond all its neighbours in 70 % of the frames, more
    than ten of the panel's usual deviations from the median of 3 × 3 pixels; near the axis, where small parts of the object
    stand still on the panel, it has to be sharper than these.
    """
    known = ~scan.valid.any(0)
    if scan.frames < _LEAST_FRAMES:
        text = f"fewer than {_LEAST_FRAMES} frames"
        finding = Finding(_QUESTION, CANNOT_TELL, 0.0, _SHARE, "share of pixels", text)
        return finding, np.zeros(known.shape, bool)
    chosen = np.unique(np.linspace(0, scan.frames - 1, _MOST_FRAMES).round().astype(int))
    frames = np.asarray(scan.projections)[chosen]
    apart = _apart(frames) & ~(_shared(frames) & _near_axis(scan))
    dead = (_constant(frames) | apart) & ~known
    count = int(dead.sum())
    share = count / max(int((~known).sum()), 1)
    text = f"{count} pixels ({100 * share:.3g} %) that the mask does not have"
    if share <= _SHARE:
        return Finding(_QUESTION, OK, share, _SHARE, "share of pixels", text), dead
    row, column = (int(i[0]) for i in np.nonzero(dead))
    text += f", the first at row {row}, column {column}"
    advice = "add them to pixel_mask: phyradgs reconstruct then leaves them out"
    return Finding(_QUESTION, SUSPICIOUS, share, _SHARE, "share of pixels", text, advice), dead


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


def _apart(frames: np.ndarray) -> np.ndarray:
    """Pixels beyond all their neighbours in most frames, by far: edges of the object pass, or have neighbours alike."""
    ring = _AROUND.copy()
    ring[1, 1] = False
    above = np.mean([frame > scipy.ndimage.maximum_filter(frame, footprint=ring) for frame in frames], axis=0)
    below = np.mean([frame < scipy.ndimage.minimum_filter(frame, footprint=ring) for frame in frames], axis=0)
    apart = np.median([frame - scipy.ndimage.median_filter(frame, size=3) for frame in frames], axis=0)
    usual = _NORMAL_MAD * float(np.median(np.abs(apart - np.median(apart))))
    floor = 1e-3 * float(np.percentile(frames, 99.9))
    far = np.abs(apart - np.median(apart)) > _DEVIATIONS * max(usual, floor, 1e-12)
    return far & (np.maximum(above, below) > _MOST_TIMES)


def _near_axis(scan: Scan) -> np.ndarray:
    """Columns (u,) bool that see the axis of rotation, where parts of the object stand still."""
    time_s = scan.frame_start_s[:1] + scan.shutter.middle_s
    source, corner, u, v = scan.trajectory.pose(0, time_s)[0].reshape(4, 3)
    column = np.linalg.lstsq(np.stack([u, v, source], axis=1), source - corner, rcond=None)[0][0]
    return np.abs(np.arange(scan.geometry.detector_shape[1]) - column) <= _NEAR_AXIS


def _shared(frames: np.ndarray) -> np.ndarray:
    """Pixels whose distance from the median of 5 × 5 their four neighbours share (one of which may be dead itself)."""
    apart = np.median([frame - scipy.ndimage.median_filter(frame, size=5) for frame in frames], axis=0)
    wide = np.pad(apart, 1, mode="edge")
    sides = np.median([wide[:-2, 1:-1], wide[2:, 1:-1], wide[1:-1, :-2], wide[1:-1, 2:]], axis=0)
    return sides * np.sign(apart) > _SHARED * np.abs(apart)
