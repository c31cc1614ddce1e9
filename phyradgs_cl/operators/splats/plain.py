"""Conversion between users' device arrays, in mm and without padding, and the layout of the splat kernels."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl.fields.gaussians import DENSITY, ROWS
from phyradgs_cl.operators.splats.layout import DeviceGaussians, stride_of
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD, Strides, move, padded_zeros, pitch_of


@dataclass(eq=False)
class SplatPoint:
    """A cloud in the kernels' layout, and the norms (stride,) of the user's quaternions."""

    gaussians: DeviceGaussians
    norms: DeviceArray


class PlainRows:
    """Converts parameter rows (11, G) in mm, quaternions of any length, to internal rows in units of ``length_mm``.

    Internal densities are in 1/``length_mm`` for ``line_integrals``, which have no unit then, else in 1/mm."""

    def __init__(self, rt: Runtime, length_mm: float, *, line_integrals: bool) -> None:
        self.rt = rt
        self._density = np.float32(length_mm if line_integrals else 1)
        self._units = np.float32(1 / length_mm), self._density
        self._enter = rt.kernel("splat_plain", "rows_enter")
        self._leave = rt.kernel("splat_plain", "rows_leave")
        self._copy = rt.kernel("splat_plain", "row_copy")

    def enter(self, rows: DeviceArray) -> SplatPoint:
        """Copies rows (11, G) float32 to a cloud; the rows may change afterwards."""
        rt, count = self.rt, rows.shape[1]
        stride = stride_of(count)
        inside, norms = rt.empty((ROWS, stride)), rt.empty(stride)
        sizes = np.int32(count), np.int32(stride)
        rt.launch(self._enter, stride, rows, *sizes, *self._units, inside, norms, group=rt.group(on_cpu=16))
        return SplatPoint(DeviceGaussians(inside, count, stride), norms)

    def leave(self, gradients: DeviceArray, point: SplatPoint, rows: DeviceArray, *, add: bool = False) -> None:
        """Converts gradients (13, stride) by internal rows to gradients by plain rows (11, G); ``add`` adds to those."""
        rt, cloud = self.rt, point.gaussians
        rt.launch(
            self._leave, cloud.count, gradients, point.norms, cloud.count, cloud.stride, *self._units, add,
            rows, group=rt.group(on_cpu=16),
        )  # fmt: skip


    def with_densities(self, point: SplatPoint, density: DeviceArray) -> SplatPoint:
        """Returns the cloud with densities (G,) in 1/mm in place of its former ones."""
        rt, cloud = self.rt, point.gaussians
        rows = rt.empty((ROWS, cloud.stride))
        rt.copy(cloud.rows, rows)
        self._copy_row(density, 0, cloud.count, self._density, DENSITY * cloud.stride, rows)
        return SplatPoint(DeviceGaussians(rows, cloud.count, cloud.stride), point.norms)

    def densities(self, rows: DeviceArray) -> DeviceArray:
        """Returns the density row of plain rows (11, G)."""
        count = rows.shape[1]
        density = self.rt.empty(count)
        self._copy_row(rows, DENSITY * count, count, np.float32(1), 0, density)
        return density

    def _copy_row(
        self, source: DeviceArray, start: int, count: int, factor: np.float32, to: int, target: DeviceArray
    ) -> None:
        rt, where = self.rt, (np.int64(start), np.int32(count), factor, np.int64(to))
        rt.launch(self._copy, count, source, *where, target, group=rt.group(on_cpu=16))


class PlainImages:
    """Copies images (rows, columns) of a stack to one padded image of ``lines`` by ``width``, and back.

    ``turned`` makes columns the lines. A volume (nz, ny, nx) counts as an image of nz · ny lines."""

    def __init__(self, rt: Runtime, lines: int, width: int, *, turned: bool = False) -> None:
        self.rt, self.turned = rt, turned
        self._by_line = 1, lines, width
        self._plain = (1, width, lines) if turned else self._by_line
        self._padded = Strides(GUARD, 0, pitch_of(width))
        self._image: DeviceArray | None = None

    def enter(self, images: DeviceArray, number: int = 0) -> DeviceArray:
        """Returns image ``number`` in the padded layout, valid until the next call."""
        if self._image is None:
            self._image = padded_zeros(self.rt, *self._by_line[1:])
        source, target = (images, self._place(number)), (self._image, self._padded)
        move(self.rt, source, target, self._plain, turned=self.turned)
        return self._image

    def leave(self, image: DeviceArray, images: DeviceArray, number: int = 0) -> None:
        """Copies a padded image to image ``number``."""
        source, target = (image, self._padded), (images, self._place(number))
        move(self.rt, source, target, self._by_line, turned=self.turned)

    def _place(self, number: int) -> Strides:
        return Strides.plain(self._plain, (number, 0, 0))
