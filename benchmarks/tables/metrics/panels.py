"""A figure of many reconstructions side by side: one column each, with the same slices and grey values in all."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.errors import InputError, OutputError

Images = Sequence[NDArray[np.floating]]
_INCH, _DPI = 1.9, 110


def panels_png(path: str | Path, columns: Sequence[tuple[str, Images]], title: str) -> None:
    """Writes a PNG with one column for each (heading, images). The first column is the truth.

    Grey values extend over the first column's range, with 0, so that a wrong gain shows. Images are (rows, columns), with
    row 0 at the bottom, and every column has the same number of them. ``title``: heading of the figure. Raises InputError
    for no column or columns of different lengths, and OutputError for a file that cannot be written."""
    from matplotlib.figure import Figure  # only figures need it, and its import is slow

    counts = {len(images) for _, images in columns}
    if len(counts) != 1 or counts == {0}:
        raise InputError("columns of a figure", f"{sorted(counts)} images", "the same number, at least 1")
    count = counts.pop()
    low = min(0.0, *(float(image.min()) for image in columns[0][1]))
    high = max(low + 1e-12, *(float(image.max()) for image in columns[0][1]))
    figure = Figure(figsize=(len(columns) * _INCH, count * _INCH + 0.7), layout="constrained")
    figure.suptitle(title, fontsize=10)
    axes = figure.subplots(count, len(columns), squeeze=False)
    for column, (heading, images) in enumerate(columns):
        axes[0, column].set_title(heading, fontsize=7)
        for row, image in enumerate(images):
            axes[row, column].imshow(image, cmap="gray", vmin=low, vmax=high, origin="lower")
            axes[row, column].set_axis_off()
    try:
        figure.savefig(path, dpi=_DPI, format="png")
    except OSError as error:
        raise OutputError(str(path), str(error), "a file that can be written") from error
