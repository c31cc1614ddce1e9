"""What a calibration did: residuals of a few frames before and after, and what single views were off by."""

from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl.calibrate.finding import Calibration
from phyradgs_cl.drawing import draw_image, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FRAMES = 4
_ROW_INCH, _CURVES_INCH, _WIDTH_INCH = 1.8, 2.4, 7.0


def calibration_figure(calibration: Calibration) -> "Figure":
    """Four frames from top to bottom, residuals before on the left and after on the right, blue below and red above what the
    volume explains, all on one scale; below, turns and shifts over the views, where some were corrected."""
    before, after = calibration.before, calibration.after
    frames = np.unique(np.linspace(0, len(before) - 1, _FRAMES).round().astype(int))
    curves = calibration.per_view()
    heights = [_ROW_INCH] * len(frames) + [_CURVES_INCH] * bool(curves)
    figure = new_figure(_WIDTH_INCH, sum(heights))
    rows = figure.add_gridspec(len(heights), 2, height_ratios=heights)
    limit = float(np.percentile(np.abs(before[frames]), 99.5)) or 1.0
    for row, frame in enumerate(frames):
        for column, (words, images) in enumerate((("before", before), ("after", after))):
            rms = float(np.sqrt(np.mean(np.square(images[frame], dtype=np.float64))))
            title = f"residual {frame + 1} of {len(before)} {words}: RMS {rms:.3g}"
            draw_image(figure.add_subplot(rows[row, column]), images[frame], title, cmap="RdBu_r", vmin=-limit, vmax=limit)
    for column, unit in enumerate(("deg", "mm")):
        own = {name: values for name, values in curves.items() if name.endswith(unit)}
        if not own:
            continue
        _draw_curves(figure.add_subplot(rows[len(frames), column]), own, unit)
    return figure


def _draw_curves(axes: "Axes", curves: dict[str, np.ndarray], unit: str) -> None:
    for name, values in curves.items():
        axes.plot(values, lw=1.2, label=name.removesuffix(f"_{unit}").replace("_", " "))
    axes.set(xlabel="view", ylabel=unit)
    axes.set_title("corrected by view", fontsize=9)
    axes.legend(fontsize=7)
    axes.spines[["top", "right"]].set_visible(False)
