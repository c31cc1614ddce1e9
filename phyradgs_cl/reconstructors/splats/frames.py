"""A scan's frames on the device as the splatting engine sees them: time cells, measurements and masks, internal units."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from phyradgs_cl.acquisition import Exact, Motion, Scan, TimeCells
from phyradgs_cl.detector import transmission_weights
from phyradgs_cl.operators import DeviceCells
from phyradgs_cl.reconstructors.splats.options import SplatOptions
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import pad_rows

_PEAK_PERCENTILE = 99.9  # noise has peaks of its own


@dataclass(frozen=True)
class Scale:
    """What one internal unit is: of length in mm, of density in 1/mm."""

    length_mm: float
    density_per_mm: float

    @property
    def line_integral(self) -> float:
        return self.length_mm * self.density_per_mm


class DeviceFrames:
    """The scan on the device: time cells, measurement in internal units and mask of every frame."""

    def __init__(self, rt: Runtime, scan: Scan, options: SplatOptions, scale: Scale) -> None:
        self.count = scan.frames
        readout = scan.shutter.readout
        self.lines, self.width = readout.shape(scan.geometry.detector_shape)
        model = scan.detector_model if options.detector_model == "scan" else options.detector_model
        tables, merges = tables_of(scan, options.motion, model)
        self._cells = [DeviceCells.upload(rt, table.scaled(1 / scale.length_mm)) for table in tables]
        self.intensity_unit = scale.line_integral if merges else None
        measured = (frame / np.float32(scale.line_integral) for frame in scan.projections)
        self._measured = [rt.upload(pad_rows(readout.frames(m))) for m in measured]
        self._mask, self._pixels = _upload_masks(rt, scan)
        self._transmission: list[DeviceArray] = []
        if options.poisson_weight > 0:
            valid = None if scan.pixel_mask is None else scan.pixel_mask == 0
            trust = transmission_weights(scan.projections, valid)
            self._transmission = [rt.upload(pad_rows(readout.frames(t))) for t in trust]

    def cells(self, frame: int) -> DeviceCells:
        """The time cells of a frame."""
        return self._cells[frame]

    def transmission(self, frame: int) -> DeviceArray | None:
        """Weights of the Poisson term, where it counts."""
        return self._transmission[frame] if self._transmission else None

    @property
    def most_cells(self) -> int:
        """The largest number of time cells of a frame."""
        return max(cells.count for cells in self._cells)

    def get(self, frame: int) -> tuple[DeviceCells, DeviceArray, DeviceArray, float]:
        shared = frame if len(self._mask) > 1 else 0
        return self._cells[frame], self._measured[frame], self._mask[shared], self._pixels[shared]


def tables_of(scan: Scan, motion: Motion, model: str) -> tuple[list[TimeCells], bool]:
    """The time cells of every frame, in mm, and whether a detector of this model merges intensities of several."""
    peak = float(np.percentile(scan.projections, _PEAK_PERCENTILE)) if model == "intensity" else 0.0
    cells = partial(motion.cells, intensity_peak=peak) if isinstance(motion, Exact) else motion.cells
    tables = [cells(scan, frame) for frame in range(scan.frames)]
    # of one value both models are the mean
    return tables, model == "intensity" and any(table.averages for table in tables)


def _upload_masks(rt: Runtime, scan: Scan) -> tuple[list[DeviceArray], list[float]]:
    """Masks that are 1 where a pixel counts: one for all frames, or one per frame."""
    if scan.pixel_mask is None:
        masks = [np.ones(scan.geometry.detector_shape, np.float32)]
    else:
        stack = scan.pixel_mask if scan.pixel_mask.ndim == 3 else scan.pixel_mask[None]
        masks = [(m == 0).astype(np.float32) for m in stack]
    arrays = [rt.upload(pad_rows(scan.shutter.readout.frames(m))) for m in masks]
    return arrays, [float(m.sum()) for m in masks]
