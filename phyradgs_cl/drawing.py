"""What figures share: images with a scale bar, colours, and a figure that terminals and notebooks both show.

matplotlib is imported when something is drawn.
"""

import importlib
import math
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

EXPOSED, EDGE, CURVE, RESTING = "#f3d37a", "#8a6d1a", "#b3261e", "#2b5c8a"
_BAR = 0.3  # of a picture's width, at most


def new_figure(width_inch: float, height_inch: float) -> "Figure":
    """An empty figure: pyplot's where somebody has imported that, so that ``show()`` finds it; else one by itself."""
    if "ipykernel" in sys.modules:
        with suppress(ImportError):  # a cell shows what it ends with, once
            importlib.import_module("matplotlib_inline.backend_inline")
    elif "matplotlib.pyplot" in sys.modules:
        return sys.modules["matplotlib.pyplot"].figure(figsize=(width_inch, height_inch), layout="constrained")
    from matplotlib.figure import Figure

    return Figure(figsize=(width_inch, height_inch), layout="constrained")


def draw_image(
    axes: "Axes", image: np.ndarray, title: str, *, size_mm: tuple[float, float] | None = None, **how: Any
) -> None:
    """An image (rows, columns), row 0 below, with a bar of its values, and of its length where ``size_mm`` (v, u) is known.

    how: as of ``imshow``.
    """
    rows, columns = image.shape
    height, width = (rows, columns) if size_mm is None else size_mm
    drawn = axes.imshow(image, origin="lower", extent=(0, width, 0, height), **how)
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()
    if size_mm is not None:
        bar_mm = round_length(_BAR * width)
        left, bottom = 0.04 * width, 0.04 * height
        axes.plot([left, left + bar_mm], [bottom, bottom], color=CURVE, lw=2, solid_capstyle="butt")
        axes.text(left, bottom + 0.02 * height, f"{bar_mm:g} mm", color=CURVE, fontsize=8, va="bottom")
    if axes.figure is not None:
        axes.figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.02).ax.tick_params(labelsize=7)


def round_length(most: float) -> float:
    """The largest 1, 2 or 5 times a power of ten up to ``most``."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(f * power for f in (1, 2, 5) if f * power <= most * (1 + 1e-9))
