"""A figure of the three middle slices beside the truth."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import finite, shape
from phyradgs_cl.drawing import draw_image, new_figure
from phyradgs_cl.errors import OutputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.metrics.quality import psnr, ssim
from phyradgs_cl.text import plain_text

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

Image = NDArray[np.floating]
_INCH, _DPI = 3.2, 110


def slices_png(path: str | Path, result: ArrayLike, reference: ArrayLike, title: str) -> None:
    """Writes a PNG: a row for each middle slice, the columns result, truth and difference. z and y point up.

    Grey values run over the truth's range, so that a wrong gain shows. The difference has its own scale, symmetric about 0.
    result, reference: (z, y, x). ``title``: the heading's first line. Raises InputError for shapes that differ, NaN and
    infinity, and OutputError for a file that cannot be written."""
    volume, truth = np.asarray(result), np.asarray(reference)
    figure = new_figure(3 * _INCH * 1.25, 3 * _INCH + 0.6)
    figure.suptitle(plain_text(f"{title}\n{_numbers(volume, truth)}"), parse_math=False)  # a dollar in a file's name is one
    draw_slices(figure, volume, truth, None)
    try:
        figure.savefig(path, dpi=_DPI, format="png")
    except OSError as error:
        raise OutputError(str(path), str(error), "a file that can be written") from error


def _numbers(result: Image, reference: Image) -> str:
    if not reference.max(initial=0) > 0:
        return "empty truth"
    return f"PSNR {psnr(result, reference):.2f} dB, SSIM {ssim(result, reference):.4f}"


def draw_slices(figure: "FigureBase", volume: Image, truth: Image | None, grid: Grid | None) -> None:
    """Draws the three middle slices of a volume (z, y, x) in 1/mm, and those of a truth and of the difference."""
    if truth is not None:
        shape("reference", truth, volume.shape)
        finite("reference", truth)
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
