"""Colours, axes, curves and images for the figures of notebooks, reports and the documentation. matplotlib is slow to
import, so functions import it only when they draw."""

import importlib
import math
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# In a report's page each colour is a CSS variable of this name, so that a dark theme can change it.
COLOURS = {
    "ink": "#1b2430",
    "soft": "#5a6675",
    "faint": "#e9ecf0",
    "accent": "#1f5fa8",
    "lit": "#f0cf74",
    "edge": "#86681a",
    "sample": "#b3261e",
    "volume": "#dfe5ec",
}
INK, SOFT, FAINT, ACCENT, EXPOSED, EDGE, SAMPLE, BOX = COLOURS.values()
_LONGEST_BAR = 0.3  # largest length of the scale bar, as a fraction of a picture's width
_LOG_RATIO = 20.0  # an axis is logarithmic if its values are above 0 and (largest) / (smallest) exceeds this


def new_figure(width_inch: float, height_inch: float) -> "Figure":
    """Returns an empty figure. If the user has imported pyplot outside a notebook, pyplot makes the figure, so that
    ``plt.show()`` shows it."""
    if "ipykernel" in sys.modules:
        with suppress(ImportError):  # with this backend a notebook shows a returned figure, and shows it once
            importlib.import_module("matplotlib_inline.backend_inline")
    elif "matplotlib.pyplot" in sys.modules:
        return sys.modules["matplotlib.pyplot"].figure(figsize=(width_inch, height_inch), layout="constrained")
    from matplotlib.figure import Figure

    return Figure(figsize=(width_inch, height_inch), layout="constrained")


def style_axes(axes: "Axes", x_label: str, y_label: str) -> None:
    """Labels the axes, hides the top and right sides, and draws light horizontal grid lines."""
    axes.set_xlabel(x_label, color=INK)
    axes.set_ylabel(y_label, color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(SOFT)
    axes.tick_params(color=SOFT, labelcolor=SOFT, labelsize="small")
    axes.grid(axis="y", color=FAINT)
    axes.set_axisbelow(True)


def draw_curve(axes: "Axes", x: Sequence[float], y: Sequence[float], x_label: str, y_label: str) -> None:
    """Draws a curve. The vertical axis is logarithmic if all values are positive and span more than a factor of 20."""
    axes.plot(x, y, color=ACCENT, lw=1.8)
    if 0 < _LOG_RATIO * min(y) < max(y):
        axes.set_yscale("log")
    style_axes(axes, x_label, y_label)


def draw_image(
    axes: "Axes", image: np.ndarray, title: str, *, size_mm: tuple[float, float] | None = None, **how: Any
) -> None:
    """Draws an image (rows, columns), row 0 at the bottom, with a colour bar. size_mm: height and width of the image; with
    them a scale bar is drawn. how: further arguments of ``imshow``."""
    rows, columns = image.shape
    height, width = (rows, columns) if size_mm is None else size_mm
    drawn = axes.imshow(image, origin="lower", extent=(0, width, 0, height), **how)
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()
    if size_mm is not None:
        bar_mm = round_length(_LONGEST_BAR * width)
        left, bottom = 0.04 * width, 0.04 * height
        axes.plot([left, left + bar_mm], [bottom, bottom], color=SAMPLE, lw=2, solid_capstyle="butt")
        axes.text(left, bottom + 0.02 * height, f"{bar_mm:g} mm", color=SAMPLE, fontsize=8, va="bottom")
    if axes.figure is not None:
        axes.figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.02).ax.tick_params(labelsize=7)


def round_length(most: float) -> float:
    """Rounds the length ``most``, above 0, down to 1, 2 or 5 times a power of ten, for a scale bar."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(f * power for f in (1, 2, 5) if f * power <= most * (1 + 1e-9))
