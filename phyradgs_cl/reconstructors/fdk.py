"""FDK (Feldkamp, Davis and Kress 1984): cosine weight, ramp filter, distance-weighted backprojection."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from phyradgs_cl.acquisition import Motion, Scan, pixel_centres
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.operators import backproject
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, ignore_progress
from phyradgs_cl.runtime import Runtime


@dataclass(frozen=True)
class FdkOptions:
    """FDK knows one pose a frame: ``motion`` is static (mid-window) or static-start (the frame's first pose)."""

    motion: Motion = Motion("static")

    def __post_init__(self) -> None:
        if self.motion.name not in ("static", "static-start"):
            raise InputError(
                "--motion",
                repr(self.motion.name),
                "static or static-start for --method fdk",
                "use --method phyradgs to model motion",
            )


def fdk(
    scan: Scan, options: FdkOptions, rt: Runtime, *, seed: int = 0, report: ProgressReport = ignore_progress
) -> Reconstruction:
    """The FDK volume of a scan in 1/mm. ``seed`` is accepted for the common signature; FDK draws nothing."""
    started = time.perf_counter()
    pose = np.concatenate([options.motion.cells(scan, f).pose for f in range(scan.frames)])
    volume = fdk_volume(rt, unmasked_frames(scan), pose, scan.grid)
    facts = {"method": "fdk", "options": asdict(options), "seconds": time.perf_counter() - started}
    return Reconstruction(volume, scan.grid, facts=facts)


def fdk_volume(rt: Runtime, frames: np.ndarray, pose: np.ndarray, grid: Grid) -> np.ndarray:
    """FDK of line integrals (F, rows, columns) seen from one pose a frame (F, 12), on ``grid``, 1/mm.

    Full turn: each view counts with half the real angular gap to its neighbours (every ray is seen twice).
    """
    source, normal, dso_mm, dsd_mm = _central_geometry(pose)
    du_mm = np.linalg.norm(pose[:, 6:9], axis=1)
    filtered = np.empty_like(frames, dtype=np.float32)
    for f, frame in enumerate(frames):
        to_pixel = pixel_centres(pose[f], frame.shape) - source[f]
        cosine = dsd_mm[f] / np.linalg.norm(to_pixel, axis=-1)
        filtered[f] = ramp_filter(frame * cosine, du_mm[f] * dso_mm[f] / dsd_mm[f])
    weight = 0.5 * angular_gaps(source) * (dso_mm / dsd_mm) ** 2
    return backproject(rt, filtered, pose, weight, grid)


def ramp_filter(rows: np.ndarray, spacing_mm: float) -> np.ndarray:
    """Ram-Lak along the last axis in its space-domain form (Kak and Slaney, Eq. 61), zero-padded twofold."""
    width = rows.shape[-1]
    length = next_fast_len(2 * width)
    n = np.minimum(np.arange(length), length - np.arange(length))
    kernel = np.where(n % 2 == 1, -1.0 / (np.pi * np.maximum(n, 1)) ** 2, 0.0)
    kernel[0] = 0.25
    spectrum = rfft(rows, length, axis=-1) * rfft(kernel).real
    return (irfft(spectrum, length, axis=-1)[..., :width] / spacing_mm).astype(np.float32)


def angular_gaps(source: np.ndarray) -> np.ndarray:
    """Half the angle between each view's two neighbours around the turn, radians, from sources (F, 3)."""
    angle = np.arctan2(source[:, 1], source[:, 0])
    order = np.argsort(angle, kind="stable")
    ahead = np.diff(angle[order], append=angle[order[0]] + 2 * np.pi)
    gaps = np.empty(len(angle))
    gaps[order] = (ahead + np.roll(ahead, 1)) / 2
    return gaps


def unmasked_frames(scan: Scan) -> np.ndarray:
    """The scan's line integrals with masked pixels filled in, for methods that cannot leave pixels out."""
    if scan.pixel_mask is None:
        return scan.projections
    return fill_masked(scan.projections, np.broadcast_to(scan.pixel_mask != 0, scan.projections.shape))


def fill_masked(frames: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Frames (F, v, u) with masked pixels linearly interpolated along their row (0 in a row without any)."""
    filled = frames.copy()
    for f, v in zip(*np.nonzero(mask.any(axis=-1)), strict=True):
        bad = mask[f, v]
        good = np.flatnonzero(~bad)
        filled[f, v, bad] = np.interp(np.flatnonzero(bad), good, filled[f, v, good]) if good.size else 0.0
    return filled


def _central_geometry(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Source (F, 3), detector normal (F, 3), distances from source to axis and to detector plane (F,), mm."""
    source = pose[:, 0:3]
    normal = np.cross(pose[:, 6:9], pose[:, 9:12])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    dsd_mm = np.abs(np.einsum("fi,fi->f", normal, pose[:, 3:6] - source))
    dso_mm = np.linalg.norm(source[:, :2], axis=1)
    if np.any(dso_mm <= 0):
        raise InputError("poses", "a source on the rotation axis", "a source beside it")
    return source, normal, dso_mm, dsd_mm
