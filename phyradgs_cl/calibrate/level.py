"""The frames of one or two scans at one coarseness, their operator under any change, and the volume that fits them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from phyradgs_cl.acquisition import PerRow, Scan
from phyradgs_cl.calibrate.moved import Change, Sway, Views, drift_course, moved
from phyradgs_cl.check.coarse import binned, coarse_grid, fewer_frames, smooth
from phyradgs_cl.check.questions.timing import exposure_arc_rad
from phyradgs_cl.detector import noise_level
from phyradgs_cl.detector.attenuation import TRANSMISSION_FLOOR
from phyradgs_cl.fields import Grid
from phyradgs_cl.objective import TvProx
from phyradgs_cl.operators.rays.operator import RayOperator
from phyradgs_cl.reconstructors.voxels.cgls import Cgls
from phyradgs_cl.reconstructors.voxels.fista_tv import FistaTv, FistaTvOptions
from phyradgs_cl.reconstructors.voxels.priors import axis_weights
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime

MOST_FRAMES = 60
_MOST_SAMPLES = 8
_VOXELS_PER_SAMPLE = 2.0  # that the object's edge moves in an exposure
_SMOOTH = 0.8  # of a block
_TV = FistaTvOptions(tv_weight=0.0005, tv_iterations=8)


@dataclass(frozen=True, eq=False)
class Level:
    """``scans`` as they are stated, with at most 60 frames each; measured (F, rows, columns): the frames of all of them in
    blocks of ``block`` pixels, 0 where ``valid`` is not; ``grid``: the volume's. ``before`` likewise: transmission of the
    frame before each, of scans whose lag is looked for; ``course`` (F,): of a drift. ``count_pass`` is called once per
    iteration, which passes through the frames forward and back."""

    rt: Runtime
    scans: Sequence[Scan]
    block: int
    grid: Grid
    measured: np.ndarray
    valid: np.ndarray | None
    course: np.ndarray
    before: np.ndarray | None = None
    count_pass: Callable[[], None] = lambda: None

    @classmethod
    def of(
        cls,
        rt: Runtime,
        asks_lag: bool,
        scans: Sequence[Scan],
        columns: int,
        most_frames: int = MOST_FRAMES,
    ) -> "Level":
        """Blocks such that the longer side has at most ``columns`` of them."""
        block = math.ceil(max(scans[0].geometry.detector_shape) / columns)

        def made_small(scan: Scan) -> Scan:
            return binned(_smoothed(fewer_frames(scan, most_frames), block), block)

        fewer = [fewer_frames(scan, most_frames) for scan in scans]
        small = [made_small(scan) for scan in scans]
        grid = coarse_grid(scans[0].grid, small[0].geometry, 1.0)
        measured = np.concatenate([np.asarray(scan.projections, np.float32) for scan in small])
        valid = np.concatenate([scan.valid for scan in small])
        bare = [replace(s, projections=np.broadcast_to(np.float32(0), s.projections.shape)) for s in fewer]
        course = np.concatenate([drift_course(scan) for scan in fewer])
        before = np.concatenate([_through_before(scan, made_small) for scan in scans]) if asks_lag else None
        level = cls(rt, bare, block, grid, measured, None if valid.all() else valid, course, before)
        return replace(level, measured=level.masked(measured))

    def at(self, change: Change) -> "Level":
        """The frames without the lag and the drift that they would then have."""
        measured = self.measured
        if self.before is not None:
            lag = self.scans[0].lag + change.lag
            through = (np.exp(-measured) - lag * self.before) / (1 - lag)
            measured = -np.log(np.maximum(through, TRANSMISSION_FLOOR))
        measured = measured + change.drift * self.course[:, None, None]
        return replace(self, measured=self.masked(measured.astype(np.float32)), before=None)

    @property
    def is_intensity(self) -> bool:
        return self.scans[0].detector_model == "intensity"

    def operator(self, change: Change, views: Views | Sway | None = None) -> RayOperator:
        """A of all frames after a change."""
        tables = []
        for scan in self.scans:
            small = binned(moved(scan, change, views), self.block)
            voxels = exposure_arc_rad(scan) * max(self.grid.shape[1:]) / 2
            motion = PerRow(sub_intervals=int(np.clip(math.ceil(voxels / _VOXELS_PER_SAMPLE), 2, _MOST_SAMPLES)))
            tables += [motion.cells(small, frame) for frame in range(small.frames)]
        return RayOperator(self.rt, self.grid, small.geometry.detector_shape, tables)

    def masked(self, frames: np.ndarray) -> np.ndarray:
        return frames if self.valid is None else np.where(self.valid, frames, np.float32(0))

    def line_integrals(self, operator: RayOperator, volume: np.ndarray) -> np.ndarray:
        """The measurement as A x would explain it: what averaging intensity hides in edges is added, as of ``volume``."""
        if not self.is_intensity:
            return self.measured
        return self.measured + self.masked(operator.intensity_gap(volume))

    def reconstruct(self, operator: RayOperator, start: np.ndarray | None, iterations: int) -> np.ndarray:
        """A volume with little total variation, none of it negative, from ``start`` on."""
        volume = np.zeros(self.grid.shape, np.float32) if start is None else start
        system = System(operator, self.line_integrals(operator, volume), self.valid)
        method = FistaTv(system, _TV, TvProx(self.rt, self.grid.shape, axis_weights(self.grid)))
        projected = system.expected(volume)
        there = {"volume": volume, "previous": volume, "projected": projected, "projected_previous": projected}
        method.restore({**method.state(), **there})
        for _ in range(iterations):
            method.step()
            self.count_pass()
        return method.volume

    def compared(self, frames: np.ndarray) -> np.ndarray:
        """What of frames is compared with the measured ones (F · pixels)."""
        return self.masked(frames).ravel()

    def residual(self, operator: RayOperator, volume: np.ndarray) -> np.ndarray:
        """What a volume leaves of the frames (F, rows, columns)."""
        return self.line_integrals(operator, volume) - self.masked(operator.forward(volume))

    def noise(self, residual: np.ndarray) -> float:
        """Standard deviation of a pixel's noise; a volume fits some of it, so that the residual would say too little."""
        return noise_level(self.measured, self.valid)

    def off_range(
        self, operator: RayOperator, volume: np.ndarray, images: Sequence[np.ndarray], iterations: int
    ) -> list[np.ndarray]:
        """What of each image (F, rows, columns) no volume, be it this one or another, explains, as far as CGLS gets."""
        return [self._off_range(operator, image, iterations) for image in images]

    def _off_range(self, operator: RayOperator, frames: np.ndarray, iterations: int) -> np.ndarray:
        method = Cgls(System(operator, self.masked(frames), self.valid))
        for _ in range(iterations):
            if method.finished:
                break
            method.step()
            self.count_pass()
        return method.residual


def _smoothed(scan: Scan, block: int) -> Scan:
    """Smoothed for blocks of so many pixels; not across rows that are read one after the other: they see the object turned,
    which mixed would look like a readout that is too short. Columns are: a readout shears what they see, and that stays."""
    if block == 1:
        return scan
    width = _SMOOTH * block
    is_rolling = scan.shutter.readout_s > 0 and scan.shutter.axis == "rows"
    return smooth(scan, (0.0 if is_rolling else width, width))


def _through_before(scan: Scan, made_small: Callable[[Scan], Scan]) -> np.ndarray:
    """Transmission (F, rows, columns) of the frame before each, none before the first: the beam was off."""
    frames = np.asarray(scan.projections)
    small = made_small(replace(scan, projections=np.concatenate([frames[:1], frames[:-1]])))
    through: np.ndarray = np.exp(-np.asarray(small.projections, np.float32))
    through[0] = 0
    return through
