"""FDK (Feldkamp, Davis and Kress 1984), and filtered backprojection of parallel beams (FBP), both in three steps: weights of
rays, ramp filter, backprojection. FDK's backprojection is weighted by distance.

The ramp filter is Ram-Lak's in its space-domain form, with windows on its spectrum: A. C. Kak and M. Slaney, Principles of
Computerized Tomographic Imaging, IEEE Press 1988, Eq. 61 of chapter 3."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan, Static
from phyradgs_cl.acquisition.altered.angles import azimuth_rad, middle_poses
from phyradgs_cl.acquisition.motion import LINE_POSES, LineMiddles, MotionOptions, motions_for
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.operators import backproject, backproject_lines
from phyradgs_cl.operators.warp.backproject import MovingBackprojector
from phyradgs_cl.operators.warp.states import MotionStates
from phyradgs_cl.prepare.step import unmasked_frames
from phyradgs_cl.reconstructors.fdk import travel
from phyradgs_cl.reconstructors.fdk.frames import WAYS, deblurred, extrapolated, reprojected, whole_object
from phyradgs_cl.reconstructors.fdk.views import RayWeight, Views, check_beam, ray_weight, warn_if_incomplete
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, ignore_progress, option_facts
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.text import without_warnings

log = logging.getLogger(__name__)
_BLOCK_BYTES = 1 << 26  # frames are filtered in blocks of at most this many bytes, to limit memory
_WORKERS = -1  # tells SciPy's Fourier transforms to use all cores

# Windows of the ramp filter, as functions of (frequency)/(Nyquist frequency). All are 1 at 0, so they keep the mean.
WINDOWS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "ram-lak": np.ones_like,
    "shepp-logan": lambda share: np.sinc(share / 2),
    "cosine": lambda share: np.cos(np.pi / 2 * share),
    "hamming": lambda share: 0.54 + 0.46 * np.cos(np.pi * share),
    "hann": lambda share: 0.5 + 0.5 * np.cos(np.pi * share),
}


@dataclass(frozen=True)
class FdkOptions(MotionOptions):
    """Options of FDK. window: the window of the ramp filter, one of ``WINDOWS``. extrapolate: how rows continue beyond the
    panel, one of ``WAYS``.

    motion: static (one pose per frame, midway between first and last light), static-start (at its first light) or per-row
    (every line at the middle of its own exposure). Of a model with several poses per line FDK uses the middle one."""

    MOTIONS: ClassVar[tuple[Motion, ...]] = motions_for(LINE_POSES)
    METHOD: ClassVar[str] = "fdk"

    window: str = checks.option("ram-lak", words=WINDOWS, subject="FDK window")
    motion: Motion = LineMiddles()
    extrapolate: str = checks.option("none", words=WAYS)


@dataclass(frozen=True)
class FbpOptions(FdkOptions):
    """Options of FBP, with those of FDK. deblur: removes a fly-scan's motion blur along the angle. The value is (power of
    noise)/(power of signal), such as 0.01; 0: off. circle: sets voxels to 0 outside the circle about the axis that the
    panel's wider side sees, unless rows are extrapolated."""

    METHOD: ClassVar[str] = "fbp"
    deblur: float = checks.ranged(0.0, 0, 1)
    circle: bool = True


def fdk(
    scan: Scan, options: FdkOptions, rt: Runtime, *, seed: int = 0, report: ProgressReport = ignore_progress,
    deformation: Deformation | None = None,
) -> Reconstruction:
    """Returns the FDK volume of a scan in 1/mm, or with ``FbpOptions`` the filtered backprojection of a parallel beam. Both
    take short scans, full turns, and full turns with the axis near the panel's edge. The volume of a moving object shows the
    object's reference state.

    ``seed`` has no effect. report: gets progress only with extrapolate ``reprojected``. deformation: how the object moves.

    Logs a warning for incomplete turns, and for an orbit that is not a circle about z. Raises InputError for the other
    method's beam, for an orbit far from a circle, and for parallel rays that are not at right angles to the axis."""
    started, method = time.perf_counter(), options.METHOD
    if deformation is not None and options.extrapolate == "reprojected":
        expected, remedy = "another way of rows beyond the panel", "leave extrapolate out"
        raise InputError("--object-motion", "extrapolate=reprojected, of an object at rest", expected, remedy)
    frames, numbers = _measured_frames(scan)
    poses = [options.motion.cells(scan, f).still().line_poses() for f in numbers]
    # if some frames have a pose for each line, frames with one pose repeat it for all lines
    lines = max(map(len, poses))
    pose = np.concatenate(poses) if lines == 1 else np.stack([np.broadcast_to(p, (lines, 12)) for p in poses])
    check_beam(method, pose, scan.is_parallel)
    if isinstance(options, FbpOptions) and options.deblur > 0:
        middles = np.stack([p[len(p) // 2] for p in poses])
        frames = deblurred(scan, frames, azimuth_rad(middles), options.deblur)
    frames, pose = _without_dark_sides(scan, frames, pose)
    whole = partial(whole_object, scan, options.motion, rt, report)
    volume = fdk_volume(
        rt, frames, pose, scan.grid, window=options.window, axis=scan.shutter.axis,
        extrapolate=options.extrapolate, whole=whole, is_parallel=scan.is_parallel,
        moving=None if deformation is None else _moving(rt, scan, options.motion, numbers, deformation),
        circle=isinstance(options, FbpOptions) and options.circle,
    )  # fmt: skip
    facts = {"method": method, "options": option_facts(options), "seconds": time.perf_counter() - started}
    return Reconstruction(volume, scan.grid, facts=facts)


def _without_dark_sides(scan: Scan, frames: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns frames (F, rows, columns) and poses without the columns at both sides that are masked in all frames. Values
    there would be guesses. A panel without them gets the ray weights of a narrower panel. A scan with metal keeps them."""
    seen = np.flatnonzero(scan.valid.any(axis=(0, 1)))
    if scan.metal is not None or len(seen) in (0, frames.shape[2]):
        return frames, pose
    columns = slice(int(seen[0]), int(seen[-1]) + 1)
    if pose.ndim == 3 and scan.shutter.axis == "columns":
        pose = pose[:, columns]
    moved = pose.copy()
    moved[..., 3:6] += columns.start * pose[..., 6:9]
    return frames[:, :, columns], moved


def _moving(
    rt: Runtime, scan: Scan, motion: Motion, numbers: np.ndarray, deformation: Deformation
) -> MovingBackprojector | None:
    """Returns the backprojector of a moving object for frames ``numbers``, each at its mean time; None for one at rest."""
    times_s = np.array([motion.cells(scan, f).time_s.mean() for f in numbers])
    states = MotionStates.of_times(deformation, scan.grid, times_s)
    return None if states.is_at_rest else MovingBackprojector(rt, states, states.shares(times_s))


def _check(scan: Scan, options: FdkOptions) -> None:
    """Raises InputError for a beam of the wrong kind, and for orbits and views that FDK or FBP cannot take."""
    pose = middle_poses(scan)[_measured(scan)]
    with without_warnings():  # ``fdk`` itself warns of approximations
        check_beam(options.METHOD, pose, scan.is_parallel)
    if isinstance(options, FbpOptions) and options.deblur > 0:
        deblurred(scan, np.zeros((len(pose), 1, 1), np.float32), azimuth_rad(pose), options.deblur)


_KIND: dict[str, Any] = {"is_resumable": False, "takes_deformation": True, "check": _check}
METHOD = Method(fdk, {window: FdkOptions(window) for window in WINDOWS}, **_KIND)
FBP_METHOD = Method(fdk, {window: FbpOptions(window) for window in WINDOWS}, **_KIND)


def fdk_volume(
    rt: Runtime, frames: np.ndarray, pose: np.ndarray, grid: Grid, *, window: str = "ram-lak",
    axis: str = "rows", extrapolate: str = "none", whole: Callable[[], np.ndarray] | None = None,
    is_parallel: bool = False, circle: bool = False, moving: MovingBackprojector | None = None,
) -> np.ndarray:
    """Returns the volume (nz, ny, nx) float32 in 1/mm on ``grid``, by FDK or, for parallel beams, by FBP, from line
    integrals ``frames`` (F, rows, columns).

    pose: (F, 12) mm, or (F, lines, 12) with a pose for every line along ``axis``. Displaced detectors (full turns) and short
    scans are recognised and weighted. whole: returns the complete object (nz, ny, nx) in 1/mm on ``grid``, which extrapolate
    ``reprojected`` needs. circle: sets voxels outside of the circle that the panel reaches to 0. moving: backprojects an
    object that moves. Logs a warning if data are missing. Raises InputError for a source on the rotation axis."""
    views = Views(pose, frames.shape[1:], axis, is_parallel)
    if extrapolate != "none" and views.fan.is_put_aside:
        log.warning("%s: the rows of a displaced detector are not extrapolated", views.name)
    elif extrapolate != "none":
        if extrapolate == "reprojected" and whole is not None:
            frames, count = reprojected(rt, frames, views, whole(), grid)
        else:
            frames, count = extrapolated(frames, extrapolate)
        views, circle = views.extended((count, count)), False  # from here on, the views have a wider panel
    warn_if_incomplete(views, grid)
    # only a full turn has the opposite rays that complete a displaced detector
    missing = views.fan.missing_columns if views.arc.is_full else (0, 0)
    travels = travel.travels(views.middle, views.shape[0], is_parallel)
    ends = [] if travels or moving is not None else travel.ends(views, grid)
    spare = 1 if ends else 0
    filtered = _filtered(frames, ray_weight(views), missing, window, spare)
    wide, share = views.extended(missing), 0.5 * views.arc.gap_rad  # 0.5, because a full turn measures every ray twice
    of_views = partial(_of_views, rt, wide.extended((spare, spare), "rows"), share, grid, moving)
    if travels:
        volume = travel.seen_volume(filtered, views, wide, grid, of_views)
    else:
        volume = of_views(filtered, np.arange(len(filtered)))
    if ends:
        travel.fill_ends(rt, volume, ends, views, wide, share, grid)
    if circle:
        _, y_mm, x_mm = grid.axes_mm()
        # up to the outer edge of the last pixel
        radius_mm = views.seen_mm + np.linalg.norm(views.canonical[0, 0, 0, 6:9]) / 2
        volume[:, np.hypot(y_mm[:, None], x_mm) > radius_mm] = 0
    return volume


def _of_views(
    rt: Runtime, views: Views, share: np.ndarray, grid: Grid, moving: MovingBackprojector | None,
    images: np.ndarray, numbers: np.ndarray, power: int = 2,
) -> np.ndarray:  # fmt: skip
    """Backprojects ``images`` (n, rows, columns) of the views numbered ``numbers`` (n,), weighted by ``share`` (F,). power:
    of the distance weight. With 1 a moving object, ``moving``, counts as at rest."""
    pose, factor, axis, is_parallel = views.pose[numbers], share[numbers], views.axis, views.is_parallel
    if moving is not None and power == 2:
        return moving.of_views(numbers)(images, pose, factor, grid, axis, is_parallel=is_parallel)
    if pose.ndim == 2:
        return backproject(rt, images, pose, factor, grid, is_parallel=is_parallel, power=power)
    return backproject_lines(rt, images, pose, factor, grid, axis, is_parallel=is_parallel, power=power)


def _filtered(
    frames: np.ndarray, weight: RayWeight, missing: tuple[int, int], window: str, spare: int = 0
) -> np.ndarray:
    """Returns weighted and filtered frames (F, rows + 2 spare, columns + Σ missing) float32. weight: returns the weights
    (rows, columns) of a view. missing: numbers of columns added at the two ends, to hold the filter's response beyond a
    displaced detector. spare: number of rows of zeros added at both ends."""
    views, rows, columns = frames.shape
    width = columns + sum(missing)
    filtered = np.zeros((views, rows + 2 * spare, width), np.float32)
    count = max(1, _BLOCK_BYTES // (4 * rows * width))
    for first in range(0, views, count):
        block = np.zeros((min(count, views - first), rows, width), np.float32)
        for i, frame in enumerate(frames[first : first + count]):
            measured = block[i, :, missing[0] : missing[0] + columns]
            np.multiply(frame, weight(first + i), out=measured, casting="same_kind")
        filtered[first : first + count, spare : spare + rows] = ramp_filter(block, 1.0, window)
    return filtered


def ramp_spectrum(length: int, window: str = "ram-lak") -> np.ndarray:
    """Returns the ramp filter's real spectrum (length // 2 + 1,) for a pixel pitch of 1 and a period of ``length`` samples.

    It comes from the space-domain kernel: sampling |frequency| instead would add a wrong constant to every row."""
    # distance from sample 0, counted around the period: samples of the second half have negative distances
    n = np.minimum(np.arange(length), length - np.arange(length))
    kernel = np.where(n % 2 == 1, -1.0 / (np.pi * np.maximum(n, 1)) ** 2, 0.0)
    kernel[0] = 0.25
    spectrum = scipy.fft.rfft(kernel).real
    return spectrum * WINDOWS[window](np.arange(spectrum.size) / (length / 2))


def ramp_filter(rows: np.ndarray, spacing_mm: float, window: str = "ram-lak") -> np.ndarray:
    """Applies the ramp filter along the last axis of ``rows`` (..., width), zero-padded so that nothing wraps around.

    The result has the same shape, in float32, in the unit of ``rows`` per mm. Float32 rows are filtered in float32."""
    width = rows.shape[-1]
    length = scipy.fft.next_fast_len(2 * width, real=True)
    spectrum = scipy.fft.rfft(rows, length, axis=-1, workers=_WORKERS)
    spectrum *= (ramp_spectrum(length, window) / spacing_mm).astype(spectrum.real.dtype)
    filtered = scipy.fft.irfft(spectrum, length, axis=-1, overwrite_x=True, workers=_WORKERS)
    return filtered[..., :width].astype(np.float32, copy=False)


def static_fdk(rt: Runtime, scan: Scan, deformation: Deformation | None = None) -> np.ndarray:
    """Returns the volume (nz, ny, nx) in 1/mm of FDK, or of FBP in a parallel beam, from each frame's mid-exposure pose.
    Other methods start from it or scale by it, without its warnings. deformation: how the object moves; None: it rests."""
    frames, numbers = _measured_frames(scan)
    pose = np.concatenate([Static().cells(scan, f).pose for f in numbers])
    moving = None if deformation is None else _moving(rt, scan, Static(), numbers, deformation)
    with without_warnings():  # they name densities of a volume that is no result
        return fdk_volume(rt, frames, pose, scan.grid, is_parallel=scan.is_parallel, moving=moving)


def _measured_frames(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    """Returns the frames (n, rows, columns) of ``_measured``, with masked pixels filled in, and their numbers (n,)."""
    frames, numbers = unmasked_frames(scan), _measured(scan)
    return frames if len(numbers) == scan.frames else frames[numbers], numbers


def _measured(scan: Scan) -> np.ndarray:
    """Returns the numbers (n,) of the frames with more than half as many valid pixels as the frame with most. Views beside a
    frame that is left out stand for its angle. With one mask for all frames, or no valid pixel, none is left out."""
    if np.asarray(scan.pixel_mask).ndim == 3 and (valid := scan.valid.mean(axis=(1, 2))).any():
        return np.flatnonzero(valid > valid.max() / 2)
    return np.arange(scan.frames)
