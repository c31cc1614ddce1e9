"""Compares a volume with a reference by PSNR and structural similarity (SSIM), and a motion with the true motion.

SSIM (Z. Wang et al., IEEE Trans. Image Process. 13(4), 600-612, 2004) is taken in 2D, with an 11×11 Gaussian window of sigma
1.5 and zeros beyond the border. As in the published tables of radiative Gaussian splatting, SSIM is averaged over the slices
across each axis, except slices that are 0 throughout in the reference, and then over the axes."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl import checks
from phyradgs_cl.drawing import draw_image, new_figure
from phyradgs_cl.errors import InputError, OutputError
from phyradgs_cl.fields import Deformation, Grid
from phyradgs_cl.text import plain_text

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
WINDOW = 11  # SSIM's window, in voxels a side (Wang et al. 2004)
SIGMA = 1.5  # standard deviation in voxels of the Gaussian weights in SSIM's window (Wang et al. 2004)
K1, K2 = 0.01, 0.03  # SSIM's constants for means and for variances, as fractions of the data range (Wang et al. 2004)
_VOXELS_PER_BATCH = 1 << 20  # voxels compared at a time: SSIM holds about ten float64 arrays of them, 80 MB
_EDGE = 0.25  # motions are compared at edges, which show them: where the slope is at least this fraction of the steepest
_MOST_POINTS = 2000  # most voxels at which motions are compared: enough for a mean and a 95th percentile
_INCH = 3.2  # side of a slice in the figure, in inches
_DPI = 110


@dataclass(frozen=True)
class Metric:
    """How a metric is printed: its title, its unit and the format of its numbers."""

    title: str
    unit: str
    form: str

    def text(self, value: float) -> str:
        return f"{value:{self.form}} {self.unit}".rstrip()

    @property
    def heading(self) -> str:
        """The title and the unit, for the head of a table's column."""
        return f"{self.title} ({self.unit})" if self.unit else self.title


METRICS = {"psnr_db": Metric("PSNR", "dB", ".2f"), "ssim": Metric("SSIM", "", ".4f")}
"""The results of ``compare`` that are printed, and how each is printed."""
HELD_OUT = {"holdout_rms": Metric("held-out RMS", "", ".4g"), "holdout_noise_rms": Metric("noise RMS", "", ".4g")}
"""How results of ``holdout_errors`` are printed, in line integrals: the residual at held-out pixels, and their noise."""


def printed(metrics: Mapping[str, object], names: Mapping[str, Metric] = METRICS) -> Iterator[tuple[str, str]]:
    """Yields (title, value with unit) for each of ``names`` whose entry in ``metrics`` is a number."""
    for name, metric in names.items():
        value = metrics.get(name)
        if isinstance(value, int | float):
            yield metric.title, metric.text(value)


def compare(volume: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Returns psnr_db in dB, ssim (of slices across all three axes) and data_range, the maximum of ``reference``. volume,
    reference: (z, y, x) in the same unit.

    Raises InputError for a reference without a value above 0, shapes that differ, masked arrays, NaN and infinity."""
    for name, values in {"volume": volume, "reference": reference}.items():
        if not isinstance(values, np.ndarray):
            remedy = "of a result or scan: its .volume or .reference"
            raise InputError(name, f"a {type(values).__name__}", "an array (z, y, x)", remedy)
        checks.unmasked(name, values)
    peak = float(reference.max(initial=0.0))
    if peak <= 0:
        raise InputError("reference", f"a maximum of {peak:g}", "a volume with something in it")
    return {"psnr_db": psnr(volume, reference, peak), "ssim": ssim(volume, reference, peak), "data_range": peak}


def psnr(result: ArrayLike, reference: ArrayLike, data_range: float | None = None) -> float:
    """Returns 10 · log10(data_range² / mean squared error) in dB over all voxels, without clipping. Equal arrays: infinity.

    ``data_range``: by default the reference's maximum. Raises InputError for shapes that differ, NaN, infinity, and a range
    not above 0."""
    a, b, peak = checked_pair(result, reference, data_range)
    # One slice at a time: float64 copies of whole volumes would triple the memory.
    squares = sum(float(np.sum((p.astype(np.float64) - q) ** 2)) for p, q in zip(a, b, strict=True))
    return math.inf if squares == 0 else 10 * math.log10(peak**2 * a.size / squares)


def checked_pair(result: ArrayLike, reference: ArrayLike, data_range: float | None) -> tuple[Floats, Floats, float]:
    """Returns both arrays, with at least one axis, and the data range of ``psnr``. Raises InputError as ``psnr`` does."""
    pair = {"result": result, "reference": reference}
    a, b = (np.atleast_1d(checks.real_array(name, values, "biuf")) for name, values in pair.items())
    checks.shape("result", a, b.shape)
    if b.size == 0:
        raise InputError("reference", f"shape {b.shape}", "at least one voxel")
    checks.finite("result", a)
    checks.finite("reference", b)
    peak = float(b.max()) if data_range is None else data_range
    checks.positive("data range (by default the reference's maximum)", peak)
    return a, b, peak


def ssim(result: ArrayLike, reference: ArrayLike, data_range: float | None = None) -> float:
    """Returns the mean structural similarity, at most 1, of two volumes (z, y, x): the mean over slices across each axis, of
    the three axes. Slices that are 0 throughout in the reference do not count.

    ``data_range``: L in C1 = (0.01 L)², C2 = (0.03 L)², by default the reference's maximum. Raises InputError for arrays
    that are not 3D, shapes that differ, NaN or infinity, a reference of zeros, and a range that is not positive."""
    a, b, peak = checked_pair(result, reference, data_range)
    checks.shape("reference", b, (None, None, None))
    return float(np.mean([_along_axis(a, b, peak, axis) for axis in range(3)]))


def ssim_map(result: ArrayLike, reference: ArrayLike, data_range: float) -> Array:
    """Returns SSIM (..., v, u) float64 at every pixel of two stacks of images (..., v, u). data_range: L, as in ``ssim``."""
    a, b = np.asarray(result, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    c1, c2 = (K1 * data_range) ** 2, (K2 * data_range) ** 2
    mean_a, mean_b = _blur(a), _blur(b)
    both = mean_a * mean_b
    squares = mean_a**2 + mean_b**2
    variances = _blur(a * a) + _blur(b * b) - squares
    covariance = _blur(a * b) - both
    return ((2 * both + c1) * (2 * covariance + c2)) / ((squares + c1) * (variances + c2))


def _along_axis(result: Floats, reference: Floats, peak: float, axis: int) -> float:
    """Returns the mean SSIM of the slices across ``axis``, without slices that are 0 throughout in the reference. Raises
    InputError for a reference of zeros."""
    a, b = np.moveaxis(result, axis, 0), np.moveaxis(reference, axis, 0)
    full = np.flatnonzero(b.any(axis=(1, 2)))
    if full.size == 0:
        raise InputError("reference", "zeros only", "a volume that is not empty")
    size = max(1, _VOXELS_PER_BATCH // b[0].size)
    batches = (full[i : i + size] for i in range(0, full.size, size))
    total = sum(float(ssim_map(a[batch], b[batch], peak).mean(axis=(1, 2)).sum()) for batch in batches)
    return total / full.size


def _blur(images: Array) -> Array:
    """Applies SSIM's Gaussian window, whose weights sum to 1, over the last two axes, with zeros beyond the images."""
    offsets = np.arange(WINDOW) - WINDOW // 2
    weights = np.exp(-0.5 * (offsets / SIGMA) ** 2)
    weights /= weights.sum()
    rows = scipy.ndimage.correlate1d(images, weights, axis=-2, mode="constant")
    return scipy.ndimage.correlate1d(rows, weights, axis=-1, mode="constant")


def edge_points_mm(volume: np.ndarray, grid: Grid) -> np.ndarray:
    """Returns the centres (n, 3) in mm, x y z, of at most 2,000 voxels at which a volume (nz, ny, nx) changes steeply."""
    axes = [axis for axis, count in enumerate(volume.shape) if count > 1]
    slopes = [np.gradient(volume, grid.voxel_size_mm[axis], axis=axis) for axis in axes]
    steepness = np.sqrt(np.sum(np.square(slopes), axis=0)) if axes else np.zeros(volume.shape)
    where = np.argwhere(steepness >= _EDGE * steepness.max())
    where = where[:: checks.ceil_div(len(where), _MOST_POINTS)]
    return np.stack([axis[i] for axis, i in zip(grid.axes_mm(), where.T, strict=True)][::-1], -1)


def displaced_mm(deformation: Deformation, points_mm: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Returns the displacement (K − 1, n, 3) in mm of matter at points (n, 3), from the first of K times to each other time.

    The result does not depend on the time that the reference volume shows, so that two descriptions of one motion agree."""
    weights = deformation.weights_at(times_s)
    reference_mm = points_mm + deformation.displacement_mm(points_mm, weights[0])
    return np.stack([reference_mm + deformation.inverse_mm(reference_mm, other) - points_mm for other in weights[1:]])


def motion_error_mm(
    estimate: Deformation, truth: Deformation, points_mm: np.ndarray, times_s: np.ndarray
) -> tuple[float, float]:
    """Returns the mean and 95th percentile of the distance in mm between two motions of the matter at ``points_mm`` (n, 3).

    Both motions start from these points at the first time; distances are taken at all later times. Raises InputError for
    fewer than two times."""
    if len(times_s) < 2:
        raise InputError("states", str(len(times_s)), "at least two, between which the object moves")
    error_mm = displaced_mm(estimate, points_mm, times_s) - displaced_mm(truth, points_mm, times_s)
    distance_mm = np.linalg.norm(error_mm, axis=-1)
    return float(distance_mm.mean()), float(np.percentile(distance_mm, 95))


def slices_png(path: str | Path, result: ArrayLike, reference: ArrayLike, title: str) -> None:
    """Writes a PNG of middle slices: a row for each axis; columns for result, reference and difference. z and y point up.

    Grey values extend over the reference's range, so that a wrong gain shows. The difference has a scale symmetric about
    0. result, reference: (z, y, x). ``title``: the heading's first line. Raises InputError for shapes that differ, NaN and
    infinity, and OutputError for a file that cannot be written."""
    volume, truth, _ = checked_pair(result, reference, 1.0)
    figure = new_figure(3 * _INCH * 1.25, 3 * _INCH + 0.6)
    figure.suptitle(plain_text(f"{title}\n{_scores(volume, truth)}"), parse_math=False)  # a dollar sign is text, not TeX
    draw_slices(figure, volume, truth, None)
    try:
        figure.savefig(path, dpi=_DPI, format="png")
    except OSError as error:
        raise OutputError(str(path), str(error), "a file that can be written") from error


def _scores(result: Floats, reference: Floats) -> str:
    if not reference.max(initial=0) > 0:
        return "empty truth"
    return f"PSNR {psnr(result, reference):.2f} dB, SSIM {ssim(result, reference):.4f}"


def draw_slices(figure: "FigureBase", volume: Floats, truth: Floats | None, grid: Grid | None) -> None:
    """Draws a volume's middle slices (z, y, x); with ``truth`` also its slices and the difference; with ``grid`` in mm."""
    if truth is not None:
        checks.shape("reference", truth, volume.shape)
        checks.finite("reference", truth)
    shown = volume if truth is None else truth
    low, high = min(0.0, float(shown.min())), float(shown.max())
    high = high if high > low else low + 1.0
    grey = {"cmap": "gray", "vmin": low, "vmax": high}
    panels = figure.subplots(3, 1 if truth is None else 3, squeeze=False)
    for axis, name in enumerate("zyx"):
        index = volume.shape[axis] // 2
        image = volume.take(index, axis=axis)
        sides = None if grid is None else [side for a, side in enumerate(grid.size_mm) if a != axis]
        size_mm = None if sides is None else (sides[0], sides[1])
        where = f"{name} = {index}" if grid is None else f"{name} = {grid.axes_mm()[axis][index]:.3g} mm"
        unit = "" if grid is None else ", 1/mm"
        draw_image(panels[axis, 0], image, f"result{unit}, {where}", size_mm=size_mm, **grey)
        if truth is not None:
            other = truth.take(index, axis=axis)
            difference = image.astype(np.float64) - other
            limit = float(np.abs(difference).max()) or 1.0
            rms = float(np.sqrt(np.mean(difference**2)))
            draw_image(panels[axis, 1], other, f"truth, {where}", size_mm=size_mm, **grey)
            signed = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
            draw_image(panels[axis, 2], difference, f"difference, RMS {rms:.3g}", size_mm=size_mm, **signed)
