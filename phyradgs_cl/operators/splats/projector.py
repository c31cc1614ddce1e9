"""Projector of Gaussians to a frame, merged over all its time cells, and its adjoint.

This is *multi-pose batch rendering* (PhyRadGS paper, section 2.3): each kernel handles all M×N micro-views of a frame in one
launch. ``splat_prepare`` projects every Gaussian from every pose. ``splat_forward`` adds up micro-views and joins strips
(Eq. 3) directly in the merged frame; no micro-view is stored. ``splat_backward`` and ``splat_chain`` are the adjoint.

To average intensities the time cells of a line are needed separately: see ``Layers``."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.operators.splats.binning import TileLists
from phyradgs_cl.operators.splats.layout import DeviceCells, DeviceGaussians, Layers
from phyradgs_cl.operators.splats.states import CloudStates
from phyradgs_cl.runtime import DeviceArray, Kernel, Runtime
from phyradgs_cl.runtime.layout import GUARD, pad_rows, padded_zeros, pitch_of, unpad_rows

RECORD_FLOATS = {False: 16, True: 20}  # number of floats in a splat's record for a time cell; True: splats move in the cell
DEFAULT_TIME_ERROR = 0.005  # default of the largest relative RMS error of a frame whose pose moves within time cells
# Distance in standard deviations beyond which a Gaussian counts as 0: there it has fallen to 0.1 % of its peak.
DEFAULT_CUTOFF_SIGMA = 3.7
_BAND_LINES = 8  # number of detector lines of a tile on a CPU
_TILE, _PARTS = 8, 4  # on a GPU: the side of a tile in pixels, and the most work-items that share a pixel
GROUP_DEFINES = {False: {"GROUP": 1, "ACROSS": 1}, True: {"GROUP": 32, "ACROSS": 8}}
"""Build options of the adjoint, by ``Runtime.pixel_items``: the work-items per Gaussian, and how many lie along a line."""


def items_by_gaussian(rt: Runtime, count: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Returns the numbers of work-items and the work-group's sides, (x, y) each, for kernels that sum per Gaussian."""
    items, across = (GROUP_DEFINES[rt.pixel_items][name] for name in ("GROUP", "ACROSS"))
    return (count * across, items // across), ((across, items // across) if items > 1 else (16, 1))


def path_limits(time_error: float) -> tuple[float, float, float]:
    """Returns the longest path of a splat during a line's exposure, in the splat's standard deviations, for which 1, 2 or 3
    sample times suffice.

    The exposure is integrated by Gauss–Legendre rules. Their errors are at most path²/24, path⁴/1440 and path⁶/134400 of the
    peak, because the 2nd, 4th and 6th derivatives of exp(−x²/2) are at most 1, 3 and 15. An error of 2 ``time_error`` in the
    worst pixel means a relative RMS error of about ``time_error``. Longer paths are integrated in closed form, which loses
    digits for paths below 0.7."""
    worst = 2 * time_error
    one, two, three = (24 * worst) ** (1 / 2), (1440 * worst) ** (1 / 4), (134400 * worst) ** (1 / 6)
    return one, two, max(three, 0.7)


@dataclass(frozen=True)
class _Kernels:
    """The projector's four kernels, built for splats that rest in a time cell, move in it, or move only their centres."""

    prepare: Kernel
    forward: Kernel
    backward: Kernel
    chain: Kernel

    @classmethod
    def declare(cls, rt: Runtime, moving: bool, fixed_conic: bool, **options: bool) -> "_Kernels":
        by_pixel = rt.pixel_items
        defines = {"IMAGE_GUARD": GUARD, "MOVING": moving, **options}
        forward = "splat_forward_pixels" if by_pixel else "splat_forward_rows"
        backward = "splat_backward_group" if by_pixel else "splat_backward_rows"
        return cls(
            prepare=rt.kernel(
                "splat_prepare", "splat_prepare_moving" if moving else "splat_prepare", FIXED_CONIC=fixed_conic, **defines
            ),
            forward=rt.kernel("splat_forward", forward, BLOCK_PIXEL=by_pixel, **defines),
            backward=rt.kernel("splat_backward", backward, **GROUP_DEFINES[by_pixel], **defines),
            chain=rt.kernel("splat_chain", "splat_chain", FIXED_CONIC=fixed_conic, **defines),
        )


class SplatProjector:
    """Renders Gaussians to frames with ``lines`` lines (along the readout axis) of ``width`` pixels; also the derivative.

    affine: R2-Gaussian's approximation instead of the exact ray integral. cutoff_sigma: the Mahalanobis radius beyond which
    a Gaussian is not drawn; 0 draws all of it. time_error: the largest relative RMS error of averages over time in moving
    cells. intensity_unit: None averages line integrals. A number averages intensities; it is the line integral that the
    value 1 of a pixel stands for. states: moves the Gaussians of an object that moves."""

    def __init__(
        self, rt: Runtime, lines: int, width: int, *, affine: bool = False,
        cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA, time_error: float = DEFAULT_TIME_ERROR,
        intensity_unit: float | None = None, states: CloudStates | None = None,
    ) -> None:
        self.rt, self.lines, self.width = rt, lines, width
        self.pitch = pitch_of(width)
        self.cutoff2 = np.float32(cutoff_sigma**2)
        self.time_error = time_error
        self.by_pixel = rt.pixel_items
        self._cut(self.pitch, _BAND_LINES)
        self.image = padded_zeros(rt, lines, width)
        self._layers = None if intensity_unit is None else Layers(rt, lines, width, intensity_unit)
        self._records = rt.empty(1)
        self._is_visible = rt.empty(1, np.uint8)
        self._extents = rt.empty(1, np.int32)
        self.states, self._cloud = states, rt.empty(1)
        options = {"LAYERED": self._layers is not None, "DEFORMED": states is not None}
        self._kernels = {
            (moving, fixed, parallel): _Kernels.declare(
                rt, moving, fixed, AFFINE=affine or parallel, PARALLEL=parallel, **options
            )
            for moving, fixed in ((False, False), (False, True), (True, False))
            for parallel in (False, True)
        }

    def _cut(self, tile_w: int, tile_h: int) -> None:
        self.tile_w, self.tile_h = tile_w, tile_h
        tiles = (ceil_div(self.width, tile_w), ceil_div(self.lines, tile_h), 1)
        self.lists = TileLists(self.rt, (tile_w, tile_h, 1), tiles)

    @property
    def path_limits(self) -> np.ndarray:
        """What the function ``path_limits`` returns, as a kernel argument: (4,) float32, the last element unused."""
        return np.array([*path_limits(self.time_error), 0], np.float32)

    def forward(self, gaussians: DeviceGaussians, cells: DeviceCells) -> DeviceArray:
        """Renders the frame, merged over all time cells, with padded rows. Its memory is valid until the next call."""
        self.draw(gaussians, cells)
        return self.merge(cells)

    def draw(self, gaussians: DeviceGaussians, cells: DeviceCells) -> DeviceArray:
        """Renders the layers of a frame with padded rows, or the frame itself if line integrals are averaged. The layers of
        several clouds may be added before ``merge``."""
        rt, kernel = self.rt, self._kernels[cells.moving, cells.fixed_conic, cells.is_parallel].forward
        items: int | tuple[int, ...] = self.lists.total
        group: int | tuple[int, ...] = 1
        if self.by_pixel:
            group = self._group(kernel)
            items = self.width, self.lines, group[2]
            if group[:2] != (self.tile_w, self.tile_h):
                self._cut(*group[:2])
        self.prepare(gaussians, cells)
        self.lists.build(self._extents, gaussians.count, gaussians.stride, cells.count)
        drawn = self.image if self._layers is None else self._layers.images(cells)
        rt.launch(
            kernel, items, self._records, self._is_visible, cells.cells, cells.line_cells, cells.line_times,
            cells.time_pitch, self.path_limits, self.lists.tile_offsets, self.lists.splat_ids, self.lists.splat_ids.size,
            gaussians.count, cells.count, self.lines, self.width, self.pitch, self.tile_w, self.tile_h,
            ceil_div(self.width, self.tile_w), self.cutoff2, cells.layers, drawn,
            group=group, samples=self.lists.samples * cells.count,
        )  # fmt: skip
        return drawn

    def _group(self, kernel: Kernel) -> tuple[int, int, int]:
        """Returns the sides of a GPU's work-group: a tile of pixels, and the work-items that share each pixel."""
        items = self.rt.group(1, _TILE**2 * _PARTS, kernel)
        return _TILE, min(_TILE, items // _TILE), max(items // _TILE**2, 1)

    def merge(self, cells: DeviceCells) -> DeviceArray:
        """Merges the layers of the last ``draw`` to a frame. Its memory is valid until the next call."""
        if self._layers is not None:
            self._layers.merge(cells, self.image)
        return self.image

    def backward(
        self, gaussians: DeviceGaussians, cells: DeviceCells, by_image: DeviceArray, gradients: DeviceArray
    ) -> None:
        """Writes dL/d(parameters) into ``gradients`` (13, stride), with rows as in cl/common/gradient.h, from dL/d(frame)
        with padded rows.

        Before each call, call ``prepare`` or ``forward`` with the same Gaussians and cells, as ``backward`` overwrites the
        results."""
        rt = self.rt
        items, group = items_by_gaussian(rt, gaussians.count)
        by_images = by_image if self._layers is None else self._layers.split(cells, by_image)
        kernels = self._kernels[cells.moving, cells.fixed_conic, cells.is_parallel]
        rt.launch(
            kernels.backward, items, self._records, self._is_visible, cells.cells, cells.line_times,
            cells.time_pitch, self.path_limits, by_images, gaussians.count, cells.count, self.lines,
            self.pitch, self.cutoff2, group=group, samples=self.lists.samples * cells.count,
        )  # fmt: skip
        by_states = self._cloud if self.states is None else self.states.zeros(gaussians, cells)
        rt.launch(
            kernels.chain, gaussians.stride // rt.lanes, gaussians.rows, cells.cells, cells.matrices,
            self._records, self._is_visible, cells.count, gaussians.count, gaussians.stride,
            np.float32(self.width / 2), np.float32(self.lines / 2), gradients, self._cloud, cells.cell_states,
            by_states, group=rt.group(),
        )  # fmt: skip
        if self.states is not None:
            self.states.back(gaussians, cells, gradients)

    def prepare(self, gaussians: DeviceGaussians, cells: DeviceCells) -> None:
        """Projects every Gaussian from every pose. ``draw`` begins with this; ``backward`` needs its results."""
        rt = self.rt
        footprints = gaussians.stride * cells.count
        if self._records.size < footprints * RECORD_FLOATS[cells.moving]:
            self._records = rt.empty(1)  # frees the old memory now, so that the device need not hold both
            self._records = rt.empty(footprints * RECORD_FLOATS[cells.moving])
        if self._is_visible.size < footprints:
            self._is_visible = rt.empty(1, np.uint8)
            self._is_visible = rt.empty(footprints, np.uint8)
        if self._extents.size < 6 * gaussians.stride:
            self._extents = rt.empty(6 * gaussians.stride, np.int32)
        if self.states is not None:
            self._cloud = self.states.forward(gaussians, cells.shares)
        times = (cells.line_times, np.int32(cells.time_pitch)) if cells.moving else ()
        rt.launch(
            self._kernels[cells.moving, cells.fixed_conic, cells.is_parallel].prepare,
            gaussians.stride // rt.lanes, gaussians.rows, gaussians.count, gaussians.stride, cells.cells,
            cells.matrices, cells.cell_lines, cells.count, self.width, self.cutoff2, self._records,
            self._is_visible, self._extents, self._cloud, cells.cell_states, *times, group=rt.group(),
        )  # fmt: skip

    def project(self, rows: np.ndarray, cells: DeviceCells) -> np.ndarray:
        """Renders parameter rows (11, G) to a frame (lines, width) float32."""
        image = self.forward(DeviceGaussians.upload(self.rt, rows), cells)
        return unpad_rows(self.rt.download(image), (self.lines, self.width))

    def project_adjoint(self, rows: np.ndarray, cells: DeviceCells, by_image: np.ndarray) -> np.ndarray:
        """Returns dL/d(rows), (11, G), at parameter rows (11, G) from dL/d(frame), (lines, width)."""
        gaussians = DeviceGaussians.upload(self.rt, rows)
        self.forward(gaussians, cells)
        gradients = self.rt.zeros((13, gaussians.stride))
        self.backward(gaussians, cells, self.rt.upload(pad_rows(by_image)), gradients)
        return self.rt.download(gradients)[:11, : gaussians.count]
