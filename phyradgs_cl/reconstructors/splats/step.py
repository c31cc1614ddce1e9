"""One step of a splatting run: its Gaussians and frames on the device, and its gradient, summed over ranks.

``FrameStep.gradient`` renders a frame, compares it, differentiates, adds total variation, and applies the chain rule.
Each rank (MPI process) has all Gaussians, and some frames of the batch. The bits of summed gradients depend on the batch,
not on the number of ranks."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from phyradgs_cl.acquisition import Exact, Motion, Scan, TimeCells
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.objective import ImageLoss, TotalVariation
from phyradgs_cl.operators import DeviceCells, DeviceGaussians, SplatProjector, Voxeliser
from phyradgs_cl.operators.splats.layout import pad_columns, stride_of
from phyradgs_cl.operators.splats.projector import DEFAULT_TIME_ERROR
from phyradgs_cl.operators.splats.states import CloudStates, segments_for_object, states_of
from phyradgs_cl.optim import DeviceAdam, Population
from phyradgs_cl.parallel import exact_sum
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import pad_rows

_PEAK_PERCENTILE = 99.9  # percentile of the line integrals that counts as their peak; their maximum is often noise
_ROWS = 11  # number of a Gaussian's parameters, which are the rows of dL/d(parameters)
_STATISTICS = 2  # number of rows of statistics: each Gaussian's sum of gradient norms, and how many of them exceed 0
# Number of rows of ``cloud.gradients``: the 11 of dL/d(parameters), then dL/d(projected centre) along and across a line, in
# units of half the image's size.
_DERIVED = 13
Corner = tuple[int, int, int]
"""First voxel (z, y, x) of the random sub-volume whose total variation enters the loss."""


@dataclass(frozen=True)
class Scale:
    """Internal units of a splatting run: the unit of length in mm, and of density in 1/mm."""

    length_mm: float
    density_per_mm: float

    @property
    def line_integral(self) -> float:
        return self.length_mm * self.density_per_mm


class DeviceCloud:
    """A run's Gaussians on the device: the first ``count`` of the ``gaussians.stride`` columns of every array."""

    def __init__(self, rt: Runtime, population: Population) -> None:
        self.rt, self.count = rt, population.count
        stride = stride_of(self.count)
        moments = np.zeros((2, _ROWS, stride), np.float32)
        moments[:, :, : self.count] = population.moments
        self.raw = rt.upload(pad_columns(population.raw))
        self.moments = rt.upload(moments)
        self.gradients = rt.zeros((_DERIVED, stride))
        self.statistics = rt.zeros((2, stride))
        self.gaussians = DeviceGaussians(rt.zeros((_ROWS, stride)), self.count, stride)

    def population(self) -> Population:
        count = self.count
        return Population(self.rt.download(self.raw)[:, :count], self.rt.download(self.moments)[:, :, :count])

    def read_statistics(self) -> np.ndarray:
        """Returns two numbers per Gaussian, (2, count) float32: the norm of dL/d(projected centre), summed over frames, and
        the number of frames in which this norm is above 0."""
        return self.rt.download(self.statistics)[:, : self.count]

    def write_statistics(self, statistics: np.ndarray) -> None:
        padded = np.zeros((2, self.gaussians.stride), np.float32)
        padded[:, : self.count] = statistics
        self.rt.write(self.statistics, padded)


class DeviceFrames:
    """All frames of a scan on the device: their time cells, measured line integrals in internal units, and masks."""

    def __init__(
        self, rt: Runtime, scan: Scan, options: SplatOptions, scale: Scale, deformation: Deformation | None = None
    ) -> None:
        self.rt, self.scan, self.scale, self.deformation = rt, scan, scale, deformation
        self.count = scan.frames
        readout = scan.shutter.readout
        self.lines, self.width = readout.shape(scan.geometry.detector_shape)
        self._model = scan.detector_model if options.detector_model == "scan" else options.detector_model
        self.intensity_unit = scale.line_integral if self.follow(options.motion) else None
        measured = (frame / np.float32(scale.line_integral) for frame in scan.projections)
        self._measured = [rt.upload(pad_rows(readout.frames(m))) for m in measured]
        masks = np.zeros((1, *scan.geometry.detector_shape)) if scan.pixel_mask is None else scan.pixel_mask
        usable = [(m == 0).astype(np.float32) for m in (masks if masks.ndim == 3 else masks[None])]  # one, or one per frame
        self._mask = [rt.upload(pad_rows(readout.frames(m))) for m in usable]
        self._pixels = [float(m.sum()) for m in usable]

    def follow(self, motion: Motion) -> bool:
        """Uploads the time cells of a motion model. Returns whether frames are averages of intensity over a line's cells."""
        tables, merges = tables_of(self.scan, motion, self._model, self.deformation)
        of_object = self.deformation
        states = [None if of_object is None else states_of(table, of_object) for table in tables]
        scaled = (table.scaled(1 / self.scale.length_mm) for table in tables)
        self.cells = [DeviceCells.upload(self.rt, table, own) for table, own in zip(scaled, states, strict=True)]
        return merges

    def get(self, frame: int) -> tuple[DeviceCells, DeviceArray, DeviceArray, float]:
        """Returns the time cells, measurement, mask (1 at valid pixels) and number of valid pixels of frame ``frame``."""
        mask = frame if len(self._mask) > 1 else 0
        return self.cells[frame], self._measured[frame], self._mask[mask], self._pixels[mask]


def tables_of(
    scan: Scan, motion: Motion, model: str, deformation: Deformation | None = None
) -> tuple[list[TimeCells], bool]:
    """Returns the time cells of every frame in mm, and whether frames are averages of intensity over a line's cells.

    If the model ``exact`` chooses its number of segments, a moving object raises it to what the object's paths need."""
    peak = float(np.percentile(scan.projections, _PEAK_PERCENTILE)) if model == "intensity" else 0.0
    cells = partial(motion.cells, intensity_peak=peak) if isinstance(motion, Exact) else motion.cells
    tables = [cells(scan, frame) for frame in range(scan.frames)]
    if deformation is not None and isinstance(motion, Exact) and motion.segments == 0 and scan.is_fly:
        voxel_mm, lit_s = min(scan.grid.voxel_size_mm), np.array(scan.shutter.lit_span_s)
        for frame, start_s in enumerate(scan.frame_start_s):
            needed = segments_for_object(deformation, start_s + lit_s, voxel_mm)
            if needed > tables[frame].count:
                tables[frame] = replace(motion, segments=needed).cells(scan, frame)
    # for lines with a single time, the log model and the intensity model agree
    return tables, model == "intensity" and any(table.averages for table in tables)


@dataclass(frozen=True)
class Batch:
    """The numbers of one step's frames. corners: for each frame, the first voxel of the sub-volume whose total variation
    counts; None if total variation has no weight. late: whether the density term applies, as it does from iteration
    ``parameter_terms_from`` on."""

    frames: list[int]
    corners: list[Corner | None]
    late: bool


class FrameStep:
    """Computes the gradient of the objective for one frame of a scan at a time. grid: the volume's, in internal units.
    deformation: how the object moves, in mm."""

    def __init__(
        self, rt: Runtime, scan: Scan, options: SplatOptions, scale: Scale, grid: Grid,
        deformation: Deformation | None = None,
    ) -> None:
        self.rt, self.options, self.grid, self.motion = rt, options, grid, options.motion
        self.frames = DeviceFrames(rt, scan, options, scale, deformation)
        states = None if deformation is None else CloudStates(rt, deformation.scaled(1 / scale.length_mm))
        if states is not None:
            states.check_inverse(grid)
        lines, width = self.frames.lines, self.frames.width
        self.projector = SplatProjector(
            rt, lines, width, affine=options.affine, cutoff_sigma=options.cutoff_sigma,
            time_error=getattr(options.motion, "time_error", DEFAULT_TIME_ERROR),
            intensity_unit=self.frames.intensity_unit, states=states,
        )
        self.loss = ImageLoss(rt, lines, width, self.projector.pitch, options.ssim_weight, options.l1_weight)
        z, y, x = (min(options.tv_edge, n) for n in grid.shape)
        self.crop = Voxeliser(rt, (z, y, x), cutoff_sigma=options.cutoff_sigma)
        self.tv = TotalVariation(rt, self.crop.shape, self.crop.pitch)
        self.adam = DeviceAdam(rt, options.activation(grid))
        self._losses: np.ndarray | None = None

    def follow(self, motion: Motion) -> None:
        """Makes later steps render frames with the motion model ``motion``."""
        if motion != self.motion:
            self.motion = motion
            self.frames.follow(motion)
            self.projector.time_error = getattr(motion, "time_error", DEFAULT_TIME_ERROR)

    def draw_corner(self, rng: np.random.Generator) -> Corner | None:
        """Draws the first voxel (z, y, x) of a sub-volume for total variation; None if total variation has no weight."""
        if self.options.tv_weight == 0:
            return None
        room = (n - edge + 1 for n, edge in zip(self.grid.shape, self.crop.shape, strict=True))
        z, y, x = (int(rng.integers(n)) for n in room)
        return z, y, x

    def differentiate(self, cloud: DeviceCloud, batch: Batch) -> None:
        """Writes dL/d(raw parameters) of a batch of several frames into the cloud's gradients, and adds to its statistics.
        Rank r takes frames r, r + ranks, … of the batch."""
        rt, stride, count = self.rt, cloud.gaussians.stride, len(batch.frames)
        self._losses, own = np.zeros(count), []
        for place in range(rt.ranks.rank, count, rt.ranks.size):
            statistics = rt.zeros((_STATISTICS, stride))
            self.gradient(cloud, batch.frames[place], batch.corners[place], batch.late, statistics)
            self._losses[place] = self.loss.value()
            own.append(np.concatenate([rt.download(cloud.gradients)[:_ROWS], rt.download(statistics)]))
        total = exact_sum(rt.ranks, own, (_ROWS + _STATISTICS, stride), count)
        # the rows of dL/d(projected centre) are set to 0: the statistics contain them already
        rt.write(cloud.gradients, np.pad(total[:_ROWS], ((0, _DERIVED - _ROWS), (0, 0))))
        rt.write(cloud.statistics, rt.download(cloud.statistics) + total[_ROWS:])

    def mean_loss(self) -> float:
        """Returns the mean loss of the last batch's frames; of one frame, if ``differentiate`` was not called."""
        if self._losses is None:
            return self.loss.value()
        losses = self._losses.copy()
        self.rt.ranks.allreduce_sum(losses)
        return float(losses.mean())

    def gradient(
        self, cloud: DeviceCloud, frame: int, corner: Corner | None, late: bool, statistics: DeviceArray
    ) -> None:
        """Writes one frame's dL/d(raw parameters) into the gradients of an activated cloud, and adds to the ``statistics``
        (2, stride) of density control. corner: the corner of the sub-volume for total variation, or None. late: whether the
        density term applies."""
        options, gaussians, by_cloud = self.options, cloud.gaussians, cloud.gradients
        cells, measured, mask, pixels = self.frames.get(frame)
        rendered = self.projector.forward(gaussians, cells)
        by_image = self.loss.evaluate(rendered, measured, mask, pixels)
        self.projector.backward(gaussians, cells, by_image, by_cloud)
        if corner is not None:
            by_volume = self.tv.evaluate(self.crop.forward(gaussians, self.grid, corner))
            self.crop.backward(gaussians, self.grid, by_volume, by_cloud, add=True, weight=options.tv_weight)
        own = cloud.raw, gaussians.rows, by_cloud, statistics, cloud.count, gaussians.stride
        self.adam.chain(*own, density_weight=options.density_weight if late else 0.0)
