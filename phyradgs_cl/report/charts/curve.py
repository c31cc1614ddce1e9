"""How a run converged: a chart for each quantity of its record that changed."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.io.hdf5.facts import NUMBER
from phyradgs_cl.report.charts.axes import Axes, svg
from phyradgs_cl.report.facts import label, number, unit
from phyradgs_cl.report.markup import Markup, joined

MOST_CHARTS = 3
_MOST_POINTS = 600
_LOG_FROM = 20.0  # largest over smallest value
Record = Sequence[Mapping[str, float]]


def convergence_charts(record: Record) -> list[tuple[str, Markup]]:
    """(caption, drawing) of the quantities in a convergence record over iterations; none of an empty record."""
    names = [key for line in record for key in line if key not in ("iteration", "seconds")]
    charts = []
    for name in dict.fromkeys(names):
        points = [(line.get("iteration", k + 1), line[name]) for k, line in enumerate(record) if name in line]
        values = [value for _, value in points]
        if len(points) > 1 and max(values) > min(values):
            charts.append((_caption(name, points), _chart(name, points)))
    return charts[:MOST_CHARTS]


def tuning_chart(tuned: Mapping[str, Any]) -> tuple[str, Markup]:
    """(caption, drawing) of the error on held-out pixels over the values of an option that were tried, and of the choice."""
    name, chosen, values, errors = (tuned[key] for key in ("option", "chosen", "values", "holdout_rms"))
    axes = Axes((values[0], values[-1]), (min(errors), max(errors)), log_x=values[0] > 0)
    along = np.log(values) if axes.log_x else values
    at = float(np.interp(np.log(chosen) if axes.log_x else chosen, along, errors))
    drawn = joined(
        axes.frame(name, "held-out RMS"),
        axes.polyline(zip(values, errors, strict=True), "curve"),
        *(axes.dot(value, error, "mark") for value, error in zip(values, errors, strict=True)),
        axes.polyline([(chosen, axes.y[0]), (chosen, at)], "pose"),
        axes.dot(chosen, at, "mark", 4.5),
        axes.text(chosen, at, number(chosen), shift=(0, -10), class_="strong"),
    )
    caption = f"{name}: {number(chosen)}, chosen by line integrals that the trials of the method did not see."
    return caption, svg(drawn, f"Error over {name}", caption)


def views_chart(key: str, values: object) -> tuple[str, Markup] | None:
    """(caption, drawing) of what was corrected of every view, from a file that anybody may have edited: None for anything
    but numbers."""
    if not isinstance(values, list) or len(values) < 2 or not all(map(NUMBER.fits, values)):
        return None
    low, high = min(0.0, *values), max(0.0, *values)
    axes = Axes((0.0, len(values) - 1.0), (low, high if high > low else low + 1.0))
    points = list(enumerate(values))
    drawn = joined(axes.frame("view", f"{label(key)}, {unit(key)}"), axes.polyline(points, "curve"))
    caption = f"{label(key).capitalize()} of every view, corrected."
    return caption, svg(drawn, f"{label(key).capitalize()} by view", caption)


def histogram(edges: NDArray[np.float64], counts: NDArray[np.int64]) -> Markup:
    """How often line integrals between ``edges`` (n + 1,) are there, ``counts`` (2, n): before and after."""
    axes = Axes((float(edges[0]), float(edges[-1])), (0.9, 1.2 * float(max(counts.max(), 1))), log=True)
    middles = (edges[:-1] + edges[1:]) / 2
    drawn = [axes.frame("line integral", "pixels")]
    for values, class_ in zip(counts, ("former", "curve"), strict=True):
        drawn.append(axes.polyline([(float(x), max(float(n), 0.9)) for x, n in zip(middles, values, strict=True)], class_))
    return svg(joined(*drawn), "Histogram of line integrals", "Pixels of all frames by line integral, before and after.")


def _caption(name: str, points: list[tuple[float, float]]) -> str:
    (_, first), (last, value) = points[0], points[-1]
    return f"{label(name).capitalize()}: from {number(first)} to {number(value)} at iteration {number(last)}."


def _chart(name: str, points: list[tuple[float, float]]) -> Markup:
    points = points[:: -(-len(points) // _MOST_POINTS)] + [points[-1]]
    values = [value for _, value in points]
    low, high = min(values), max(values)
    log = low > 0 and high / low > _LOG_FROM
    bottom = low if log else (0.0 if 0 <= low < 0.5 * high else low)
    axes = Axes((min(0.0, points[0][0]), points[-1][0]), (bottom, high), log)
    drawn = joined(
        axes.frame("iteration", label(name)),
        axes.polyline(points, "curve"),
        axes.dot(*points[-1], "mark", 3.5),
        axes.text(points[-1][0], points[-1][1], number(points[-1][1]), shift=(-6, -9), class_="end strong"),
    )
    return svg(drawn, f"Convergence: {label(name)} over iterations", _caption(name, points))
