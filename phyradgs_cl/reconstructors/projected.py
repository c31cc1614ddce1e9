"""Computes frames from a volume to compare them with the measured frames, also at held-out pixels.

Held-out pixels measure quality without a true volume, by cross-validation over pixels (Golub, Heath and Wahba, Technometrics
21 (1979) 215, for one parameter). All methods, options and seeds hold out the same pixels, to make errors comparable."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.acquisition import PerRow, Scan
from phyradgs_cl.detector import noise_rms
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, States
from phyradgs_cl.operators import IntensityOperator
from phyradgs_cl.operators.rays.subrays import subrays_of
from phyradgs_cl.operators.warp.operator import projector_of
from phyradgs_cl.runtime import Runtime

TIMES_PER_LINE = 16  # a line is projected at this many times of its exposure: the error is then far below the noise
_HOLDOUT_SEED = 20  # seed that draws the held-out pixels, the same in all runs
FRAMES_AT_A_TIME = 8  # frames are projected in groups of at most this many, to limit memory
Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class FramePair:
    """Frame number ``frame`` as measured, and as computed from a volume: line integrals (rows, columns), 0 where not valid.
    valid: bool (rows, columns)."""

    frame: int
    measured: Image
    computed: Image
    valid: NDArray[np.bool_]

    @property
    def residual(self) -> Image:
        """Measured minus computed line integrals (rows, columns)."""
        return self.measured - self.computed

    @property
    def rms(self) -> float:
        """Root mean square of the residual over the valid pixels, dimensionless; 0 without valid pixels."""
        return _rms(self.residual[self.valid])

    @property
    def relative(self) -> float:
        """``rms`` divided by the root mean square of the measured frame's valid pixels, or by 1 if these are all 0."""
        return self.rms / (_rms(self.measured[self.valid]) or 1.0)


def _rms(values: NDArray[np.floating]) -> float:
    return float(np.sqrt(np.mean(values.astype(np.float64) ** 2))) if values.size else 0.0


def spread_frames(frames: int, count: int) -> list[int]:
    """Returns up to ``count`` frame numbers spread evenly over a scan of ``frames`` frames, from frame 0 on."""
    count = min(count, frames)
    return [(k * frames) // count for k in range(count)]


def frame_pairs(
    rt: Runtime, scan: Scan, volume: np.ndarray, grid: Grid, frames: Sequence[int],
    moves: Deformation | States | None = None,
) -> list[FramePair]:
    """Returns the ``frames`` of a scan, each with the frame computed from a volume (nz, ny, nx) in 1/mm, under the motions
    of the gantry and of the object (``moves``). If ``moves`` is States, their volumes are used in place of ``volume``. If
    the scan's detector averages intensity, so do the computed frames."""
    motion = PerRow(sub_intervals=TIMES_PER_LINE)
    tables = [motion.cells(scan, frame) for frame in frames]
    if isinstance(moves, States):
        volume, projector = moves.volumes, projector_of(rt, grid, tables, None, moves.times_s)
    else:
        projector = projector_of(rt, grid, tables, moves)
    like, subrays = (rt, grid, scan.geometry.detector_shape, tables), subrays_of(grid, tables)
    if scan.detector_model == "intensity":
        computed = IntensityOperator(*like, projector, subrays).expected(volume)
    else:
        computed = projector(*like, subrays=subrays).forward(volume)
    pairs = []
    for frame, image in zip(frames, computed, strict=True):
        valid = scan.valid[frame]
        measured = np.where(valid, scan.projections[frame], 0).astype(np.float32)
        pairs.append(FramePair(frame, measured, np.where(valid, image, 0).astype(np.float32), valid))
    return pairs


def held_out(scan: Scan, percent: float) -> np.ndarray:
    """Returns about ``percent`` % of the valid pixels, drawn at random but the same in every run, as bool (F, v, u). Raises
    InputError if no pixel is drawn."""
    drawn = np.random.default_rng(_HOLDOUT_SEED).random(scan.projections.shape, np.float32) < percent / 100
    held: np.ndarray = drawn & scan.valid
    if not held.any():
        raise InputError("--holdout", f"{percent:g} % of {int(scan.valid.sum())} pixels", "at least one pixel", "take more")
    return held


def holdout_errors(
    rt: Runtime, scan: Scan, held: np.ndarray, volume: np.ndarray, grid: Grid,
    moves: Deformation | States | None = None,
) -> dict[str, float]:
    """Returns by name: the RMS residual of a volume (nz, ny, nx) in 1/mm at held-out pixels ``held``, bool (F, v, u), the
    RMS noise of these pixels, and their number.

    Residual and noise are dimensionless, as line integrals are. A perfect volume would leave the noise as its residual."""
    squares = 0.0
    for first in range(0, scan.frames, FRAMES_AT_A_TIME):
        frames = range(first, min(first + FRAMES_AT_A_TIME, scan.frames))
        for pair in frame_pairs(rt, scan, volume, grid, frames, moves):
            squares += float(np.sum(np.square(pair.residual[held[pair.frame]], dtype=np.float64)))
    count = int(held.sum())
    noise = noise_rms(scan.projections, held, scan.valid)
    return {"holdout_rms": float(np.sqrt(squares / count)), "holdout_noise_rms": noise, "holdout_pixels": count}
