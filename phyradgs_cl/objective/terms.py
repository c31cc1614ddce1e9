"""Terms of the objective (paper, Eq. 4): image loss, total variation of a sub-volume, mean density.

A frame's image loss is L1 + λ (1 − SSIM): mean absolute error and structural similarity. Eq. 4 prints "+ SSIM", but the
paper minimises 1 − SSIM, as this module does. SSIM follows Wang et al. 2004 (IEEE Trans. Image Process. 13, 600), with an
11-tap Gaussian window of σ 1.5, zero padding, C1 = 0.01² and C2 = 0.03².

Total variation is anisotropic, as in R2-Gaussian: the mean absolute difference between neighbouring voxels along z, plus
those along y and x."""

import math

import numpy as np
import scipy

from phyradgs_cl.checks import ceil_div
from phyradgs_cl.fields.gaussians import DENSITY
from phyradgs_cl.runtime import DeviceArray, Runtime
from phyradgs_cl.runtime.layout import GUARD

WINDOW = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
WINDOW /= WINDOW.sum()
C1 = 0.01**2  # keeps SSIM finite where means are 0; this value is for images with values from 0 to 1
C2 = 0.03**2  # keeps SSIM finite where variances are 0; this value is for images with values from 0 to 1


class ImageLoss:
    """Computes the loss of a frame of ``lines`` × ``width`` pixels, and its gradient. pitch: number of floats from one line
    to the next in memory. ssim_weight, l1_weight: the factors of 1 − SSIM and of L1."""

    def __init__(
        self, rt: Runtime, lines: int, width: int, pitch: int, ssim_weight: float, l1_weight: float = 1.0
    ) -> None:
        self.rt, self.lines, self.width, self.pitch = rt, lines, width, pitch
        self.ssim_weight, self.l1_weight = ssim_weight, l1_weight
        image = GUARD + lines * pitch
        kernels = ("ssim_moments", "ssim_map", "ssim_spread", "image_gradient")
        self._kernels = {name: rt.kernel("loss", name, IMAGE_GUARD=GUARD) for name in kernels}
        self._moments = rt.zeros(5 * image + GUARD)
        self._partials = rt.zeros(3 * image + GUARD)
        self._spread = rt.zeros(3 * image + GUARD)
        self._window = rt.upload(WINDOW, np.float32)
        self._sums = rt.zeros((rt.shape_of_lines(self._kernels["ssim_map"], width, lines)[2], 3))
        self.gradient = rt.zeros(image + GUARD)

    def evaluate(
        self, rendered: DeviceArray, measured: DeviceArray, mask: DeviceArray, pixels: float
    ) -> DeviceArray:
        """Returns dL/d(rendered), valid until the next call. mask: 1 at valid pixels, else 0. pixels: their number."""
        rt = self.rt
        vectors = ceil_div(self.width, rt.lanes)
        size = (np.int32(self.lines), np.int32(self.width), np.int32(self.pitch))
        group = rt.group()
        items, tile, _ = rt.shape_of_lines(self._kernels["ssim_map"], self.width, self.lines)
        whole, beside, _ = rt.shape_of_lines(self._kernels["image_gradient"], self.pitch, self.lines)
        images = (rendered, measured, mask, self._window)
        rt.launch(self._kernels["ssim_moments"], (vectors, self.lines), *images, *size, self._moments, group=group)
        rt.launch(
            self._kernels["ssim_map"], items, self._moments, *images, *size, np.float32(C1), np.float32(C2),
            self._partials, rt.local(12 * math.prod(tile)), self._sums, group=tile,
        )  # fmt: skip
        rt.launch(
            self._kernels["ssim_spread"], (vectors, self.lines), self._partials, self._window, *size,
            self._spread, group=group,
        )  # fmt: skip
        rt.launch(
            self._kernels["image_gradient"], whole, self._spread, *images, *size,
            np.float32(self.l1_weight / max(pixels, 1.0)),
            np.float32(self.ssim_weight / (self.lines * self.width)), self.gradient, group=beside,
        )  # fmt: skip
        return self.gradient

    def value(self) -> float:
        """Returns the loss of the last ``evaluate``, and waits for the device."""
        ssim, l1, pixels = self.rt.download(self._sums).astype(np.float64).sum(axis=0)
        return float(self.l1_weight * l1 / max(pixels, 1.0) + self.ssim_weight * (1 - ssim / (self.lines * self.width)))


def image_loss(
    rendered: np.ndarray, measured: np.ndarray, mask: np.ndarray, ssim_weight: float, l1_weight: float = 1.0
) -> tuple[float, np.ndarray]:
    """Returns the loss, and dL/d(rendered) (lines, width), of images (lines, width): the float64 twin of ``ImageLoss``."""
    x, y = rendered * mask, measured * mask
    mx, my = _blur(x), _blur(y)
    xx, yy, xy = _blur(x * x) - mx * mx, _blur(y * y) - my * my, _blur(x * y) - mx * my
    n1, n2, d1, d2 = 2 * mx * my + C1, 2 * xy + C2, mx * mx + my * my + C1, xx + yy + C2
    ssim = n1 * n2 / (d1 * d2)
    by_xx, by_xy = -ssim / d2, 2 * n1 / (d1 * d2)
    by_mean = 2 * my * n2 / (d1 * d2) - 2 * mx * ssim / d1 - 2 * mx * by_xx - my * by_xy
    by_ssim = _blur(by_mean) + 2 * x * _blur(by_xx) + y * _blur(by_xy)
    pixels = max(mask.sum(), 1.0)
    data, by_data = l1_weight * np.abs(x - y).sum() / pixels, l1_weight * np.sign(x - y) / pixels
    return float(data + ssim_weight * (1 - ssim.mean())), mask * (by_data - ssim_weight * by_ssim / x.size)


def _blur(image: np.ndarray) -> np.ndarray:
    for axis in (1, 0):
        image = scipy.ndimage.correlate1d(image, WINDOW, axis=axis, mode="constant")
    return image


class TotalVariation:
    """Computes the total variation of volumes of one ``shape`` (nz, ny, nx), and its gradient. pitch: number of floats from
    one row to the next in memory."""

    def __init__(self, rt: Runtime, shape: tuple[int, int, int], pitch: int) -> None:
        self.rt, self.shape, self.pitch = rt, shape, pitch
        nz, ny, nx = shape
        self._shape4 = np.array([nx, ny, nz, 0], np.int32)
        self._weight4 = np.array([*_axis_weights(shape)[::-1], 0], np.float32)
        self._kernel = rt.kernel("total_variation", "total_variation", IMAGE_GUARD=GUARD)
        self._sums = rt.zeros(rt.shape_of_lines(self._kernel, pitch, ny, nz)[2])
        self.gradient = rt.zeros(2 * GUARD + nz * ny * pitch)

    def evaluate(self, volume: DeviceArray) -> DeviceArray:
        """Returns dTV/d(volume) in the layout of ``volume``, valid until the next call."""
        nz, ny, _ = self.shape
        items, tile, _ = self.rt.shape_of_lines(self._kernel, self.pitch, ny, nz)
        self.rt.launch(
            self._kernel, items, volume, self._shape4, self.pitch, self._weight4, self.gradient,
            self.rt.local(4 * math.prod(tile)), self._sums, group=tile,
        )  # fmt: skip
        return self.gradient

    def value(self) -> float:
        """Returns the total variation of the last ``evaluate``, and waits for the device."""
        return float(self.rt.download(self._sums).astype(np.float64).sum())


def total_variation(volume: np.ndarray) -> tuple[float, np.ndarray]:
    """Returns the total variation of a volume (nz, ny, nx), and its gradient: the float64 twin of ``TotalVariation``."""
    volume = np.asarray(volume, np.float64)
    gradient = np.zeros_like(volume)
    value = 0.0
    for axis, weight in enumerate(_axis_weights(volume.shape)):
        difference = np.diff(volume, axis=axis)
        value += weight * np.abs(difference).sum()
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        gradient -= weight * np.diff(np.pad(np.sign(difference), pad), axis=axis)
    return float(value), gradient


def _axis_weights(shape: tuple[int, ...]) -> list[float]:
    """Returns 1/(number of differences) along each axis (z, y, x), to turn sums into means; 0 for an axis without any."""
    total = int(np.prod(shape))
    return [1.0 / (total // n * (n - 1)) if n > 1 else 0.0 for n in shape]


def mean_density(rows: np.ndarray, weight: float) -> tuple[float, np.ndarray]:
    """Returns ``weight`` times the mean density of G Gaussians with parameters ``rows`` (11, G), and its gradient (11, G) by
    these parameters: the float64 twin of this term in the kernel ``chain_activations``."""
    gradient = np.zeros_like(rows)
    if (count := rows.shape[1]) == 0:
        return 0.0, gradient
    gradient[DENSITY] = weight / count
    return float(weight * rows[DENSITY].mean()), gradient
