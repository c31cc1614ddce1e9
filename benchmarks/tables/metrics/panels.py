"""A figure of many reconstructions side by side: a column each, the same slices and grey values in all."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.errors import InputError, OutputError

Images = Sequence[NDArray[np.floating]]
_INCH, _DPI = 1.9, 110


def panels_png(path: str | Path, columns: Sequence[tuple[str, Images]], title: str) -> None:
    """Write a PNG with one column for each (heading, images); the first column is the truth.

    Grey values run over the first column's range, 0 included, so that a wrong gain shows. Row 0 of an image is
    drawn at the bottom.

    Args:
        path: file to write.
        columns: heading and images, each (rows, columns); the same number of images in every column.
        title: heading of the figure.

    Raises:
        InputError: no column, or columns of different lengths.
        OutputError: the file cannot be written.
    """
    from matplotlib.figure import Figure  # slow to import, and only figures need it

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
