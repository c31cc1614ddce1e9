"""A figure of the three middle slices beside the truth."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phyradgs_cl.checks import finite, shape
from phyradgs_cl.errors import OutputError
from phyradgs_cl.metrics.psnr import psnr
from phyradgs_cl.metrics.ssim import ssim
from phyradgs_cl.text import plain_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Image = NDArray[np.floating]
_INCH, _DPI = 3.2, 110


def slices_png(path: str | Path, result: ArrayLike, reference: ArrayLike | None, title: str) -> None:
    """Write a PNG: a row for each orthogonal middle slice; columns result, truth, difference. z and y point up.

    Grey values run over the truth's range, so that a wrong gain shows; the difference has a scale of its own, symmetric
    about 0. result, reference: (z, y, x), without a reference one column; ``title``: the heading's first line. InputError:
    not 3D, shapes that differ, NaN or infinity. OutputError: the file cannot be written.
    """
    from matplotlib.figure import Figure  # slow to import, and only figures need it

    volume = np.asarray(result)
    shape("result", volume, (None, None, None))
    finite("result", volume)
    truth = None if reference is None else np.asarray(reference)
    width = (1 if truth is None else 3) * _INCH * 1.25
    figure = Figure(figsize=(width, 3 * _INCH + 0.6), layout="constrained")
    heading = plain_text(title if truth is None else f"{title}\n{_numbers(volume, truth)}")
    figure.suptitle(heading, parse_math=False)  # a dollar in a file's name is one
    _fill(figure, volume, truth)
    try:
        figure.savefig(path, dpi=_DPI, format="png")
    except OSError as error:
        raise OutputError(str(path), str(error), "a file that can be written") from error


def _numbers(result: Image, reference: Image) -> str:
    if not reference.max(initial=0) > 0:
        return "empty truth"
    return f"PSNR {psnr(result, reference):.2f} dB, SSIM {ssim(result, reference):.4f}"


def _fill(figure: "Figure", volume: Image, truth: Image | None) -> None:
    if truth is not None:
        shape("reference", truth, volume.shape)
        finite("reference", truth)
    shown = volume if truth is None else truth
    low, high = min(0.0, float(shown.min())), float(shown.max())
    high = high if high > low else low + 1.0
    panels = figure.subplots(3, 1 if truth is None else 3, squeeze=False)
    for axis, name in enumerate("zyx"):
        index = volume.shape[axis] // 2
        image = volume.take(index, axis=axis)
        _panel(figure, panels[axis, 0], image, f"result, {name} = {index}", "gray", low, high)
        if truth is not None:
            other = truth.take(index, axis=axis)
            difference = image.astype(np.float64) - other
            limit = float(np.abs(difference).max()) or 1.0
            rms = float(np.sqrt(np.mean(difference**2)))
            _panel(figure, panels[axis, 1], other, f"truth, {name} = {index}", "gray", low, high)
            _panel(figure, panels[axis, 2], difference, f"difference, RMS {rms:.3g}", "RdBu_r", -limit, limit)


def _panel(
    figure: "Figure", axes: "Axes", image: Image, title: str, colours: str, low: float, high: float
) -> None:
    drawn = axes.imshow(image, cmap=colours, vmin=low, vmax=high, origin="lower")
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()
    figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.02).ax.tick_params(labelsize=7)
