"""Draws charts by matplotlib as SVG for the report's page: the common frame of all charts, and the charts of curves."""

import hashlib
import io
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl import checks
from phyradgs_cl.drawing import ACCENT, COLOURS, INK, SOFT, draw_curve, style_axes
from phyradgs_cl.report.markup import Markup, element, label, number, unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_CHARTS = 3  # at most this many charts of convergence fit next to each other
SIZE = 440, 320  # width and height of a chart in points of matplotlib; letters are 13 high
_STYLE: Any = {"svg.fonttype": "none", "text.parse_math": False, "font.size": 13}
Chart = tuple[str, Markup]
"""A caption and a drawing."""


def chart(draw: "Callable[[Axes], None]", title: str, description: str, size: tuple[float, float] = SIZE) -> Markup:
    """Returns an SVG element, in the page's colours, of what ``draw`` draws on axes of matplotlib. size: width and height in
    points. title, description: for screen readers."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(_STYLE), warnings.catch_warnings(), io.StringIO() as stream:
        warnings.simplefilter("ignore")  # matplotlib warns of letters that its font lacks; the browser has them
        figure = Figure(figsize=(size[0] / 72, size[1] / 72), layout="constrained")
        axes = figure.add_subplot()
        draw(axes)
        _label_powers(axes)
        figure.savefig(stream, format="svg", transparent=True)
        text = stream.getvalue()
    content = Markup(_inline(text[text.index("<svg") :]))
    box = f"0 0 {size[0]:g} {size[1]:g}"
    return element("svg", content, viewBox=box, role="img", aria_label=f"{title}. {description}", class_="drawing")


def _label_powers(axes: "Axes") -> None:
    """Labels logarithmic axes at powers of ten and, if they span less than four decades, at 2 and 5 times each power."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis, scale, (low, high) in (
        (axes.xaxis, axes.get_xscale(), axes.get_xlim()), (axes.yaxis, axes.get_yscale(), axes.get_ylim())
    ):
        if scale == "log":
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 1e4 * low else (1.0,)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
            axis.set_minor_formatter(NullFormatter())


def _inline(svg: str) -> str:
    """Returns matplotlib's SVG for use inside HTML, without its outer element, metadata, styles and clipping."""
    content = svg[svg.index(">") + 1 : svg.rindex("</svg>")]
    content = re.sub(r"<(metadata|style|clipPath)\b.*?</\1>|<!--.*?-->", "", content, flags=re.S)
    content = re.sub(r' clip-path="[^"]*"| font-family: [^;"]*;|font-family: [^;"]*; ', "", content)
    used = set(re.findall(r'xlink:href="#(\w+)"', content))
    prefix = "c" + hashlib.sha256(content.encode()).hexdigest()[:8]  # several charts of a page must not share ids
    content = re.sub(r' id="([^"]*)"', lambda m: f' id="{prefix}{m[1]}"' if m[1] in used else "", content)
    content = content.replace('xlink:href="#', f'href="#{prefix}').replace("#000000", COLOURS["ink"])
    for name, colour in COLOURS.items():
        content = content.replace(colour, f"var(--{name})")
    return content


def convergence_charts(record: Sequence[Mapping[str, float]]) -> list[Chart]:
    """Returns a chart over the iterations for each recorded quantity that changes, up to ``MOST_CHARTS``."""
    names = dict.fromkeys(key for line in record for key in line if key not in ("iteration", "seconds"))
    charts = []
    for name in names:
        points = [(line.get("iteration", k + 1), line[name]) for k, line in enumerate(record) if name in line]
        values = [value for _, value in points]
        if len(points) > 1 and max(values) > min(values):
            (last, value), words = points[-1], label(name)
            caption = f"{words.capitalize()}: from {number(values[0])} to {number(value)} at iteration {number(last)}."
            draw = partial(draw_convergence, points=points, words=words)
            charts.append((caption, chart(draw, f"Convergence of {words}", caption)))
    return charts[:MOST_CHARTS]


def draw_convergence(axes: "Axes", points: Sequence[tuple[float, float]], words: str) -> None:
    x, y = zip(*points, strict=True)
    draw_curve(axes, x, y, "iteration", words)
    axes.plot(x[-1], y[-1], "o", color=ACCENT)
    note(axes, number(y[-1]), (x[-1], y[-1]), (-4, 8), ha="right", weight="bold")
    if axes.get_yscale() == "linear" and 0 <= min(y) < 0.5 * max(y):
        axes.set_ylim(bottom=0)


def views_chart(key: str, values: object) -> Chart | None:
    """Returns a chart of one correction over the views; None for fewer than two values, or values that are no numbers.
    key: the correction's name, such as "turn_deg"."""
    if not isinstance(values, list) or len(values) < 2 or not all(map(checks.is_number, values)):
        return None
    words = label(key).capitalize()
    caption = f"{words} of every view, corrected."

    def draw(axes: "Axes") -> None:
        axes.plot(values, color=ACCENT)
        style_axes(axes, "view", f"{words}, {unit(key)}")

    return caption, chart(draw, f"{words} by view", caption)


def histogram(edges: NDArray[np.float64], counts: NDArray[np.int64]) -> Markup:
    """Returns a chart of histograms of line integrals before and after a step: ``counts`` (2, n), ``edges`` (n + 1,)."""

    def draw(axes: "Axes") -> None:
        before, after = np.maximum(counts, 0.9)  # a logarithmic axis has no 0
        axes.plot((edges[:-1] + edges[1:]) / 2, before, "--", color=SOFT)
        axes.plot((edges[:-1] + edges[1:]) / 2, after, color=ACCENT)
        axes.set_yscale("log")
        style_axes(axes, "line integral", "pixels")

    return chart(draw, "Histogram of line integrals", "Pixels of all frames by line integral, before and after.")


def profile_chart(x_mm: NDArray[Any], line: NDArray[Any], sigma: NDArray[Any], truth: NDArray[Any] | None) -> Markup:
    """Returns a chart of voxels ``line`` (n,) in 1/mm along ``x_mm``, a band of ± ``sigma`` and, if known, the ``truth``."""

    def draw(axes: "Axes") -> None:
        axes.fill_between(x_mm, line - sigma, line + sigma, color=SOFT, alpha=0.4, lw=0)
        axes.plot(x_mm, line, color=ACCENT)
        if truth is not None:
            axes.plot(x_mm, truth, "--", color=INK, lw=1)
        style_axes(axes, "x, mm", "1/mm")

    return chart(draw, "Profile with error bars", "The middle line of voxels along x.", (2 * SIZE[0], SIZE[1]))


def note(axes: "Axes", words: str, point: Any, shift: tuple[float, float], **style: Any) -> None:
    """Writes words next to a point of a chart. shift: (right, up) in 1/72 inch."""
    style = {"ha": "center", "color": INK, **style}
    axes.annotate(words, point, xytext=shift, textcoords="offset points", **style)
