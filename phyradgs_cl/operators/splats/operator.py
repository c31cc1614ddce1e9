"""Operators from Gaussians in mm and 1/mm to the frames of a scan or to a grid, with their transposed derivatives.

``rows.enter`` converts Gaussians to the kernels' layout. The result can be rendered and differentiated any number of times.
``back`` needs the Gaussians' projections, and their rendering too if intensities are averaged. It computes what it needs,
unless ``forward`` has just done so.

``by_pose`` converts dL/d(Gaussians) to dL/d(pose). Rotating the gantry has the effect of rotating the object the other way.
Shifting the panel shifts the projected centres the other way, and changes the lengths of rays."""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.fields.gaussians import DENSITY, MEAN, QUATERNION, ROWS, SCALE
from phyradgs_cl.operators.public import LinearOperator, Map, Operator, Shape, Values, computed, moved_to
from phyradgs_cl.operators.splats.layout import DeviceCells, DeviceGaussians, stride_of
from phyradgs_cl.operators.splats.projector import DEFAULT_CUTOFF_SIGMA, DEFAULT_TIME_ERROR, SplatProjector
from phyradgs_cl.operators.splats.voxelise import Voxeliser
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD, Strides, move, padded_zeros, pitch_of

QUATERNION_LENGTHS = 1e-12, 1e12  # limits of a quaternion's length: kernels square it in float32, which spans 1e-38 to 3e38
_FRAMES, _VOLUME, _ROWS, _DENSITY = "frames", "volume", "rows", "density"


@dataclass(eq=False)
class SplatPoint:
    """Gaussians in the kernels' layout. norms (stride,): the lengths of their quaternions before normalisation."""

    gaussians: DeviceGaussians
    norms: DeviceArray


class PlainRows:
    """Converts parameter rows (11, G), in mm and 1/mm with quaternions of lengths in ``QUATERNION_LENGTHS``, to the kernels'
    rows: lengths in units of ``length_mm``, and unit quaternions.

    line_integrals: densities are converted to 1/``length_mm``, so that line integrals have no unit; else they stay in
    1/mm."""

    def __init__(self, rt: Runtime, length_mm: float, *, line_integrals: bool) -> None:
        self.rt = rt
        self._density = np.float32(length_mm if line_integrals else 1)
        self._units = np.float32(1 / length_mm), self._density
        self._enter = rt.kernel("splat_plain", "rows_enter")
        self._leave = rt.kernel("splat_plain", "rows_leave")
        self._copy = rt.kernel("splat_plain", "row_copy")

    def enter(self, rows: DeviceArray) -> SplatPoint:
        """Returns a copy of parameter rows (11, G) float32, in the kernels' units and padded."""
        rt, count = self.rt, rows.shape[1]
        stride = stride_of(count)
        inside, norms = rt.empty((ROWS, stride)), rt.empty(stride)
        sizes = np.int32(count), np.int32(stride)
        rt.launch(self._enter, stride, rows, *sizes, *self._units, inside, norms, group=rt.group(on_cpu=16))
        return SplatPoint(DeviceGaussians(inside, count, stride), norms)

    def leave(self, gradients: DeviceArray, point: SplatPoint, rows: DeviceArray, *, add: bool = False) -> None:
        """Converts dL/d(kernels' rows), (13, stride), to dL/d(parameter rows in mm), (11, G), and writes them to ``rows``.
        add: adds to ``rows``, else overwrites it."""
        rt, cloud = self.rt, point.gaussians
        rt.launch(
            self._leave, cloud.count, gradients, point.norms, cloud.count, cloud.stride, *self._units, add,
            rows, group=rt.group(on_cpu=16),
        )  # fmt: skip

    def with_densities(self, point: SplatPoint, density: DeviceArray) -> SplatPoint:
        """Returns the Gaussians of ``point`` with other densities, (G,) in 1/mm."""
        rt, cloud = self.rt, point.gaussians
        rows = rt.empty((ROWS, cloud.stride))
        rt.copy(cloud.rows, rows)
        where = np.int64(0), np.int32(cloud.count), self._density, np.int64(DENSITY * cloud.stride)
        rt.launch(self._copy, cloud.count, density, *where, rows, group=rt.group(on_cpu=16))
        return SplatPoint(DeviceGaussians(rows, cloud.count, cloud.stride), point.norms)

    def densities(self, rows: DeviceArray) -> DeviceArray:
        """Returns a copy (G,) of the densities in parameter rows (11, G)."""
        count = rows.shape[1]
        density = self.rt.empty(count)
        self.rt.copy(rows, density, nbytes=4 * count, source_offset=4 * DENSITY * count)
        return density


class PlainImages:
    """Copies images of a stack (F, rows, columns) to a padded image of ``lines`` × ``width``, and back.

    turned: transposes, so that columns become lines. A volume (nz, ny, nx) counts as an image with nz · ny lines."""

    def __init__(self, rt: Runtime, lines: int, width: int, *, turned: bool = False) -> None:
        self.rt, self.turned = rt, turned
        self._by_line = 1, lines, width
        self._plain = (1, width, lines) if turned else self._by_line
        self._padded = Strides(GUARD, 0, pitch_of(width))
        self._image: DeviceArray | None = None

    def enter(self, images: DeviceArray, number: int = 0) -> DeviceArray:
        """Returns image ``number`` of the stack ``images`` with padded rows. The memory is valid until the next call."""
        if self._image is None:
            self._image = padded_zeros(self.rt, *self._by_line[1:])
        source, target = (images, self._place(number)), (self._image, self._padded)
        move(self.rt, source, target, self._plain, turned=self.turned)
        return self._image

    def leave(self, image: DeviceArray, images: DeviceArray, number: int = 0) -> None:
        """Copies a padded image to image ``number`` of the stack ``images``."""
        source, target = (image, self._padded), (images, self._place(number))
        move(self.rt, source, target, self._by_line, turned=self.turned)

    def _place(self, number: int) -> Strides:
        return Strides.plain(self._plain, (number, 0, 0))


class GaussianOperator(Operator):
    """An ``Operator`` on ``Gaussians``, or on their parameter rows (11, G). ``rows`` converts them to the kernels' layout.
    Derived classes define ``forward`` and ``back``, which work on the device."""

    def __init__(self, rows: PlainRows, range_: tuple[str, Shape], **parts: Any) -> None:
        self.rows = rows
        super().__init__(rows.rt, (_ROWS, (ROWS, None)), range_, self._at_rows, **parts)

    def forward(self, point: SplatPoint) -> DeviceArray:
        """Applies the operator to the Gaussians ``point``, in the kernels' layout. Returns y float32 on the device."""
        raise NotImplementedError

    def back(self, point: SplatPoint, by_y: DeviceArray) -> DeviceArray:
        """Returns dL/d(rows), (11, G) float32, at ``point`` from dL/dy."""
        raise NotImplementedError

    def _at_rows(self, rows: Values) -> tuple[Values, Map]:
        point = self._entered(rows)
        y = moved_to(self.rt, self.forward(point), isinstance(rows, DeviceArray))
        return y, partial(computed, self.rt, True, partial(self.back, point))

    def _entered(self, rows: Values) -> SplatPoint:
        return self.rows.enter(moved_to(self.rt, rows, True))

    def _to_array(self, side: tuple[str, Shape], values: Any) -> Values:
        array = super()._to_array(side, values.rows() if isinstance(values, Gaussians) else values)
        if isinstance(array, np.ndarray) and side is self._domain:
            _check_rows(array)
        return array


class SplatProjection(GaussianOperator):
    """The ``Operator`` from Gaussians to frames (F, rows, columns) of line integrals.

    tables: the time cells of each frame in mm, all read along one axis. length_mm: the kernels' unit of length, in which
    the scene should have a size of about 1. intensity: averages intensities over the cells of a line, else line integrals.
    average: makes the operator that averages intensities, for the frames with given numbers. affine, cutoff_sigma,
    time_error: as for ``SplatProjector``. An operator and its parts share all memory: use them one at a time."""

    _instead = f"of_densities(gaussians) is linear in densities; {Operator._instead}"

    def __init__(
        self, rt: Runtime, detector_shape: tuple[int, int], tables: Sequence[TimeCells], length_mm: float, *,
        intensity: bool = False, affine: bool = False, cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA,
        time_error: float = DEFAULT_TIME_ERROR, average: "Callable[[Sequence[int]], SplatProjection] | None" = None,
    ) -> None:
        readout = tables[0].readout
        self._is_layered, self._affine, self._average = intensity, affine, average
        self._projector = SplatProjector(
            rt, *readout.shape(detector_shape), affine=affine, cutoff_sigma=cutoff_sigma, time_error=time_error,
            intensity_unit=1.0 if intensity else None,
        )
        self._images = PlainImages(rt, self._projector.lines, self._projector.width, turned=readout.axis != "rows")
        self._tables = [DeviceCells.upload(rt, table.scaled(1 / length_mm)) for table in tables]
        self._poses = [table.pose[table.count // 2] for table in tables]
        self._ready: list[object] = []  # Gaussians and cells for which the kernels' buffers are valid; parts share this list
        self._detector_shape = detector_shape
        self._choose(range(len(tables)), PlainRows(rt, length_mm, line_integrals=True))

    def _choose(self, chosen: Sequence[int], rows: PlainRows) -> None:
        self._chosen, average = list(chosen), self._average
        self._cells = [self._tables[f] for f in chosen]
        super().__init__(
            rows, (_FRAMES, (len(chosen), *self._detector_shape)), frames=self._part,
            intensity=None if average is None else lambda: average(self._chosen),
        )

    def _part(self, few: Sequence[int]) -> "SplatProjection":
        part = copy(self)
        part.__dict__.pop("intensity", None)  # this cached operator was for all frames
        part._choose([self._chosen[f] for f in few], self.rows)
        return part

    def forward(self, point: SplatPoint) -> DeviceArray:
        """Renders Gaussians to frames (F, rows, columns) float32."""
        frames = self.rt.empty((len(self._cells), *self._detector_shape))
        self._ready.clear()  # cleared at once, because a failure below may leave the buffers half written
        for number, cells in enumerate(self._cells):
            self._images.leave(self._projector.forward(point.gaussians, cells), frames, number)
        self._ready[:] = point, self._cells[-1]
        return frames

    def back(self, point: SplatPoint, by_y: DeviceArray) -> DeviceArray:
        """Returns dL/d(rows), (11, G) float32, at ``point`` from dL/d(frames), (F, rows, columns)."""
        rt, gaussians = self.rt, point.gaussians
        by_rows, gradients = rt.empty((ROWS, gaussians.count)), rt.empty((ROWS + 2, gaussians.stride))
        for number, cells in enumerate(self._cells):
            self._differentiate(point, cells, self._images.enter(by_y, number), gradients)
            self.rows.leave(gradients, point, by_rows, add=number > 0)
        return by_rows

    def _differentiate(
        self, point: SplatPoint, cells: DeviceCells, by_image: DeviceArray, gradients: DeviceArray
    ) -> None:
        """Writes one frame's part of dL/d(kernels' rows), (13, stride), from ``by_image``, its padded dL/d(frame)."""
        is_ready = self._ready == [point, cells]
        self._ready.clear()
        if not is_ready:
            see = self._projector.forward if self._is_layered else self._projector.prepare
            see(point.gaussians, cells)  # averages of intensities need all layers, so ``forward`` draws them
        self._projector.backward(point.gaussians, cells, by_image, gradients)

    def by_poses(self, gaussians: Any, by_frames: Any) -> np.ndarray:
        """Returns dL/d(gantry angle in rad; panel shift along v, along u in pixels), (F, 3), from dL/d(frames), (F, rows,
        columns). Raises InputError for an operator that averages intensities."""
        if self._is_layered:
            raise InputError("by_poses", "averages of intensity", "averages of line integrals")
        point = self._entered(self._to_array(self._domain, gaussians))
        by_frames = moved_to(self.rt, self._to_array(self._range, by_frames), True)
        cloud, found = point.gaussians, np.empty((len(self._cells), 3))
        rows, gradients = self.rt.download(cloud.rows), self.rt.empty((ROWS + 2, cloud.stride))
        weighed = self.rt.download(self.forward(point)) * self.rt.download(by_frames)
        for number, cells in enumerate(self._cells):
            self._differentiate(point, cells, self._images.enter(by_frames, number), gradients)
            by_rows = self.rt.download(gradients)[:, : cloud.count]
            turn, along, across = by_pose(rows[:, : cloud.count], by_rows)
            shifts = [across / (self._projector.lines / 2), along / (self._projector.width / 2)]
            found[number] = turn, *(shifts[::-1] if self._images.turned else shifts)
            if not (self._affine or cells.is_parallel):  # only here a panel's shift changes the rays' lengths
                found[number, 1:] += by_length(self._poses[self._chosen[number]], weighed[number])
        return found

    def of_densities(self, gaussians: Gaussians) -> LinearOperator:
        """Returns the linear operator from densities (G,) in 1/mm to frames, for the centres and shapes of ``gaussians``.
        Raises InputError for an operator that averages intensities, which is not linear."""
        if self._is_layered:
            raise InputError("of_densities", "averages of intensity", "averages of line integrals, which are linear")
        return self._of_densities(self._entered(self._to_array(self._domain, gaussians)))

    def _of_densities(self, point: SplatPoint) -> LinearOperator:
        def forward(density: DeviceArray) -> DeviceArray:
            return self.forward(self.rows.with_densities(point, density))

        def adjoint(frames: DeviceArray) -> DeviceArray:
            return self.rows.densities(self.back(point, frames))

        return LinearOperator(
            self.rt, (_DENSITY, (point.gaussians.count,)), self._range, partial(computed, self.rt, True, forward),
            partial(computed, self.rt, True, adjoint), frames=lambda few: self.frames(few)._of_densities(point),
        )


class VoxelOperator(GaussianOperator):
    """The ``Operator`` from Gaussians to a volume (nz, ny, nx) in 1/mm: their sum at the centres of a grid's voxels."""

    def __init__(self, rt: Runtime, grid: Grid, *, cutoff_sigma: float = DEFAULT_CUTOFF_SIGMA) -> None:
        nz, ny, nx = grid.shape
        length_mm = grid.half_longest_mm
        super().__init__(PlainRows(rt, length_mm, line_integrals=False), (_VOLUME, grid.shape))
        self._inside = grid.scaled(1 / length_mm)
        self._voxeliser = Voxeliser(rt, grid.shape, cutoff_sigma=cutoff_sigma)
        self._images = PlainImages(rt, nz * ny, nx)
        self._ready: list[object] = []  # Gaussians for which the kernels' buffers are valid

    def forward(self, point: SplatPoint) -> DeviceArray:
        """Returns the volume (nz, ny, nx) float32 of Gaussians."""
        volume = self.rt.empty(self._inside.shape)
        self._ready.clear()
        self._images.leave(self._voxeliser.forward(point.gaussians, self._inside), volume)
        self._ready[:] = [point]
        return volume

    def back(self, point: SplatPoint, by_y: DeviceArray) -> DeviceArray:
        """Returns dL/d(rows), (11, G) float32, at ``point`` from dL/d(volume), (nz, ny, nx)."""
        rt, gaussians = self.rt, point.gaussians
        by_rows, gradients = rt.empty((ROWS, gaussians.count)), rt.empty((ROWS + 2, gaussians.stride))
        if self._ready != [point]:
            self._ready.clear()
            self._voxeliser.prepare(gaussians, self._inside, (0, 0, 0))
        self._voxeliser.backward(gaussians, self._inside, self._images.enter(by_y), gradients, add=False)
        self.rows.leave(gradients, point, by_rows)
        self._ready[:] = [point]
        return by_rows


def _check_rows(rows: np.ndarray) -> None:
    checks.finite(_ROWS, rows)
    if (rows[SCALE] <= 0).any():
        raise InputError(_ROWS, f"a scale of {rows[SCALE].min():g}", "scales above 0", "of logarithms: np.exp(scale)")
    lengths = np.linalg.norm(rows[QUATERNION].astype(np.float64), axis=0)
    shortest, longest = QUATERNION_LENGTHS
    if (wrong := (lengths < 0.99 * shortest) | (lengths > 1.01 * longest)).any():  # margins for the rounding of float32
        found = f"a quaternion of length {lengths[wrong][0]:g}"
        raise InputError(_ROWS, found, f"lengths from {shortest:g} to {longest:g}", "divide it by its length")


def by_pose(rows: np.ndarray, gradients: np.ndarray) -> tuple[float, float, float]:
    """Returns dL/d(gantry angle about z) per rad, and dL/d(panel shift) along and across a line.

    The unit of a shift along a line is half of the detector's width, across a line half of the number of lines. rows (11,
    G): parameters in the kernels' layout. gradients (13, G): dL/d(rows), and two rows of dL/d(projected centre)."""
    values, by = rows.astype(np.float64), gradients.astype(np.float64)
    (x, y, _), (by_x, by_y, _) = values[MEAN], by[MEAN]
    w, i, j, k = values[QUATERNION]
    turned = np.stack([-k, -j, i, w]) / 2  # dq/d(angle) for a further rotation about z
    by_object = np.sum(x * by_y - y * by_x) + np.sum(turned * by[QUATERNION])
    return -float(by_object), -float(by[11].sum()), -float(by[12].sum())


def by_length(pose: np.ndarray, weighed: np.ndarray) -> np.ndarray:
    """Returns the part (2,) of dL/d(panel shift along v, along u), in pixels, that comes from changed distances between
    source and pixels, to which line integrals are proportional. pose (12,) mm; weighed (rows, columns): frame ×
    dL/d(frame)."""
    source, first, column, row = pose.reshape(4, 3)
    v, u = (np.arange(n, dtype=np.float64) for n in weighed.shape)
    ray = first - source + v[:, None, None] * row + u[:, None] * column
    share = weighed / np.sum(ray**2, -1)
    return np.array([np.sum(share * (ray @ step)) for step in (row, column)])
