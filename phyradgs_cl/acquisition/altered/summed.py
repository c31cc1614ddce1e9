"""Makes a fly-scan from a scan with many projections: a panel that integrates while the gantry turns records the sum of
their intensities."""

import logging
from dataclasses import replace

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition.cells import shares_of_windows
from phyradgs_cl.acquisition.readout import Readout
from phyradgs_cl.acquisition.scan import Scan
from phyradgs_cl.acquisition.shutter import AXES, Shutter
from phyradgs_cl.acquisition.trajectory import (
    CircularOrbit,
    EncoderTable,
    PoseTable,
    Trajectory,
    continued,
    unwrapped,
)
from phyradgs_cl.errors import InputError

log = logging.getLogger(__name__)
_UNEVEN = 0.01  # frames are unevenly spaced if (longest interval − shortest interval) / mean interval exceeds this


def sum_frames(
    scan: Scan, count: int, readout_ratio: float = 0.0, readout: str = "rows", readout_direction: int = 1
) -> Scan:
    """Makes a fly-scan without gaps, in which each frame sums the intensities of ``count`` successive projections.

    scan: F projections (F, rows, columns), line integrals. Each projection stands for an interval about its mid-time, as
    long as the time from frame to frame, in which the gantry turns evenly. count: the number of projections in an exposure.
    readout_ratio, readout, readout_direction: how the new panel is read, as in ``fly_scan``. A line whose exposure begins
    within a projection's interval takes a fraction of that projection. The result has only frames whose projections the scan
    has. Photons, detector and object are the given scan's, so the result tests a motion model on real data. For this test
    the object's image must move by less than a pixel from projection to projection.

    Raises InputError for too few projections for one frame, a rolling shutter or lag in ``scan``, and uneven intervals."""
    if not isinstance(scan, Scan):
        raise InputError("scan", checks.short_repr(scan), "a Scan")
    checks.whole("count", count, 1, scan.frames)
    checks.within("readout_ratio", readout_ratio, 0, 1000)
    checks.one_of("readout", readout, AXES)
    step_s, first_s = _interval_s(scan)
    shutter = Shutter(count * step_s, readout_ratio * count * step_s, readout, readout_direction)
    trajectory, skipped = _continued(scan, first_s, step_s)
    frames = int((scan.frames - 2 * skipped) / count - readout_ratio + 1e-9)
    if frames < 1:
        found = f"{count} with a readout of {readout_ratio:g} exposures"
        raise InputError("count", found, f"exposure and readout within the scan's {scan.frames} projections")
    starts = skipped + count * np.arange(frames)
    windows = shutter.line_windows_s(shutter.lines(scan.geometry.detector_shape)) / step_s
    share = shares_of_windows(windows, np.arange(np.ceil(windows.max() - 1e-9) + 1))
    summed = [_sum(scan, int(start), share, shutter.readout) for start in starts]
    mask = scan.pixel_mask
    if mask is not None and mask.ndim == 3:
        mask = np.stack([is_masked for _, is_masked in summed])
    return replace(
        scan, projections=np.stack([values for values, _ in summed]), pixel_mask=mask, shutter=shutter,
        trajectory=trajectory, frame_start_s=first_s + starts * step_s, is_fly=True, detector_model="intensity",
        provenance={**scan.provenance, "summed_projections": count},
    )  # fmt: skip


def _interval_s(scan: Scan) -> tuple[float, float]:
    """Returns the interval between projections, and when the first projection's interval begins, both in s. Raises
    InputError for a rolling shutter, lag, uneven intervals and a single projection."""
    remedy = "give a scan whose frames are short, or of a gantry at rest"
    if scan.is_fly and scan.shutter.readout_s > 0:
        raise InputError("scan", f"a readout of {scan.shutter.readout_s:g} s", "a global shutter", remedy)
    if scan.lag:
        raise InputError("lag", f"{scan.lag:g}", "0", remedy)
    steps_s = np.diff(scan.frame_start_s)
    if len(steps_s) == 0 or np.ptp(steps_s) > _UNEVEN * steps_s.mean():
        raise InputError("frame_start_s", "uneven intervals", "projections at even intervals", "sort or split the scan")
    step_s = float(steps_s.mean())
    return step_s, float(scan.frame_start_s[0] + scan.shutter.middle_s - step_s / 2)


def _continued(scan: Scan, first_s: float, step_s: float) -> tuple[Trajectory, int]:
    """Returns a continuous trajectory through the projections' poses, each in the middle of its interval. Also returns the
    number of projections at each end of the scan whose intervals the trajectory does not wholly cover. first_s: when the
    first interval begins. step_s: the length of an interval."""
    middle_s = first_s + (np.arange(scan.frames) + 0.5) * step_s
    own_s = scan.middle_times_s
    if isinstance(scan.trajectory, CircularOrbit):
        angle_rad = unwrapped(np.array([scan.trajectory.angle_rad(f, np.array(t)) for f, t in enumerate(own_s)]))
        rim_px = np.abs(np.diff(angle_rad)).mean() * scan.geometry.detector_shape[1] / 2
        if rim_px > 1:
            text = "the rim moves by %.3g pixels from projection to projection: a sum has as many images of it, not a smear"
            log.warning(text, rim_px)
        orbit = CircularOrbit(scan.trajectory.geometry, EncoderTable(middle_s, angle_rad))
        return continued(orbit, step_s / 2), 0
    poses = np.concatenate([scan.trajectory.pose(f, np.array([t])) for f, t in enumerate(own_s)])
    return PoseTable(middle_s, poses, is_parallel=scan.is_parallel), 1


def _sum(scan: Scan, start: int, share: np.ndarray, readout: Readout) -> tuple[np.ndarray, np.ndarray]:
    """Returns a frame's line integrals and masked pixels, both (rows, columns). The frame sums the intensities of
    projections from ``start`` on, weighted by ``share`` (projections, lines). A pixel is masked if any of these
    projections masks it."""
    total, is_masked = np.zeros(scan.projections.shape[1:]), np.zeros(scan.projections.shape[1:], bool)
    for number, lines in enumerate(share, start):
        of_lines = np.broadcast_to(readout.spread(lines), total.shape)
        total += of_lines * np.exp(-scan.projections[number].astype(np.float64))
        is_masked |= ~scan.valid[number] & (of_lines > 0)
    return (-np.log(total)).astype(np.float32), is_masked
