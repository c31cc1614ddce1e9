"""FDK (Feldkamp, Davis and Kress 1984): ray weights, ramp filter, distance-weighted backprojection."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan, Static
from phyradgs_cl.acquisition.motion import LINE_POSES, check_motion, motions_for
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import backproject, backproject_lines
from phyradgs_cl.prepare.step import unmasked_frames
from phyradgs_cl.reconstructors.fdk import weights
from phyradgs_cl.reconstructors.fdk.arc import view_arc
from phyradgs_cl.reconstructors.fdk.beyond import reprojected, whole_object
from phyradgs_cl.reconstructors.fdk.extrapolate import WAYS, extrapolated
from phyradgs_cl.reconstructors.fdk.filters import WINDOWS, ramp_filter
from phyradgs_cl.reconstructors.fdk.views import (
    RayWeight,
    check_orbit,
    pose_of_pixels,
    ray_weight,
    view_angles,
    warn_if_incomplete,
    widened,
)
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, ignore_progress, option_facts
from phyradgs_cl.runtime import Runtime

log = logging.getLogger(__name__)
_SAME_POSE = 1e-9  # of the largest length: views whose poses differ by a turn alone share their weights
_BLOCK_BYTES = 1 << 26  # rows that are filtered at one time


@dataclass(frozen=True)
class FdkOptions:
    """``window`` is the ramp filter's (see ``WINDOWS``).

    ``motion``: static (one pose per frame, mid-window), static-start (the frame's first pose) or per-row (every line
    at the middle of its own exposure). Of a model with more poses it takes a line's middle one. ``extrapolate``: rows of an
    object wider than the panel go on beyond it, one of ``WAYS``.
    """

    MOTIONS: ClassVar[tuple[Motion, ...]] = motions_for(LINE_POSES)

    window: str = "ram-lak"
    motion: Motion = Static()
    extrapolate: str = "none"

    def __post_init__(self) -> None:
        checks.one_of("FDK window", self.window, WINDOWS)
        checks.one_of("option extrapolate", self.extrapolate, WAYS)
        check_motion(self.motion, self.MOTIONS)


def fdk(
    scan: Scan, options: FdkOptions, rt: Runtime, *, seed: int = 0, report: ProgressReport = ignore_progress
) -> Reconstruction:
    """The FDK volume of a scan in 1/mm. ``seed`` is accepted for the common signature; FDK draws nothing.

    Of orbits that are no circle about z a warning is logged; InputError for those that are far from any.
    """
    started = time.perf_counter()
    frames, numbers = _seen_frames(scan)
    poses = [options.motion.cells(scan, f).still().line_poses() for f in numbers]
    lines = max(map(len, poses))
    pose = np.concatenate(poses) if lines == 1 else np.stack([np.broadcast_to(p, (lines, 12)) for p in poses])
    check_orbit(pose)
    how = {"window": options.window, "extrapolate": options.extrapolate}
    whole = partial(whole_object, scan, options.motion, rt, report)
    volume = fdk_volume(rt, frames, pose, scan.grid, axis=scan.shutter.axis, whole=whole, **how)
    facts = {"method": "fdk", "options": option_facts(options), "seconds": time.perf_counter() - started}
    return Reconstruction(volume, scan.grid, facts=facts)


METHOD = Method(fdk, {window: FdkOptions(window) for window in WINDOWS}, is_resumable=False)


def fdk_volume(
    rt: Runtime,
    frames: np.ndarray,
    pose: np.ndarray,
    grid: Grid,
    *,
    window: str = "ram-lak",
    axis: str = "rows",
    extrapolate: str = "none",
    whole: Callable[[], np.ndarray] | None = None,
) -> np.ndarray:
    """FDK of line integrals (F, rows, columns) on ``grid``, (z, y, x) float32 in 1/mm.

    pose (F, 12) mm, or (F, lines, 12) with a pose for every line along ``axis``. Displaced detectors (full turns)
    and short scans are recognised and weighted; a warning is logged where data are missing. ``whole`` makes the
    object (z, y, x) in 1/mm on ``grid``, for ``reprojected``. Raises InputError for a source on the rotation axis.
    """
    shape = (frames.shape[1], frames.shape[2])
    by_pixel = pose_of_pixels(pose, axis)
    if np.any(np.hypot(by_pixel[..., 0], by_pixel[..., 1]) <= 0):
        raise InputError("poses", "a source on the rotation axis", "a source beside it")
    angle_rad = view_angles(by_pixel)
    canonical = weights.turned_back(by_pixel, angle_rad)
    if np.ptp(canonical, axis=0).max() <= _SAME_POSE * np.abs(canonical).max():
        canonical = canonical[:1]
    arc, fan = view_arc(angle_rad), weights.measured_fan(canonical, shape)
    if extrapolate != "none" and fan.is_put_aside:
        log.warning("FDK: the rows of a displaced detector are not extrapolated")
    elif extrapolate != "none":
        if extrapolate == "reprojected" and whole is not None:
            wide, count = reprojected(rt, frames, pose, axis, whole(), grid)
        else:
            wide, count = extrapolated(frames, extrapolate)
        return fdk_volume(rt, wide, widened(pose, axis, (count, count)), grid, window=window, axis=axis)
    warn_if_incomplete(arc, fan, canonical, grid)
    missing = fan.missing_columns if arc.is_full else (0, 0)
    filtered = _filtered(frames, ray_weight(canonical, shape, arc, fan), missing, window)
    pose = widened(pose, axis, missing)
    share = 0.5 * arc.gap_rad  # every ray is seen twice
    if pose.ndim == 2:
        return backproject(rt, filtered, pose, share, grid)
    return backproject_lines(rt, filtered, pose, share, grid, axis)


def _filtered(frames: np.ndarray, weight: RayWeight, missing: tuple[int, int], window: str) -> np.ndarray:
    """Weighted and filtered frames (F, rows, columns + missing) float32.

    A displaced detector's rows grow to be symmetric: the filter's response goes on where nothing was measured.
    """
    views, rows, columns = frames.shape
    width = columns + sum(missing)
    filtered = np.empty((views, rows, width), np.float32)
    count = max(1, _BLOCK_BYTES // (4 * rows * width))
    for first in range(0, views, count):
        block = np.zeros((min(count, views - first), rows, width), np.float32)
        for i, frame in enumerate(frames[first : first + count]):
            np.multiply(
                frame,
                weight(first + i),
                out=block[i, :, missing[0] : missing[0] + columns],
                casting="same_kind",
            )
        filtered[first : first + count] = ramp_filter(block, 1.0, window)
    return filtered


def static_fdk(rt: Runtime, scan: Scan) -> np.ndarray:
    """FDK (z, y, x) in 1/mm at the mid-window poses: what other methods start from, or measure themselves by."""
    frames, numbers = _seen_frames(scan)
    pose = np.concatenate([Static().cells(scan, f).pose for f in numbers])
    return fdk_volume(rt, frames, pose, scan.grid)


def _seen_frames(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """Frames (F, v, u) with masked pixels filled in, and their numbers: those that are masked whole are left out, as the
    views beside them then stand for the angle between."""
    frames, seen = unmasked_frames(scan), np.arange(scan.frames)
    if np.asarray(scan.pixel_mask).ndim == 3:
        seen = np.flatnonzero(scan.valid.any(axis=(1, 2)))
    return (frames, np.arange(scan.frames)) if len(seen) in (0, scan.frames) else (frames[seen], seen)
