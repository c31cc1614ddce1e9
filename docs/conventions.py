"""Draws the figure of the conventions: gantry, panel and image file, from poses that the package computes."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Rectangle

from phyradgs_cl.acquisition import ConeGeometry
from phyradgs_cl.drawing import ACCENT, EDGE, EXPOSED, SAMPLE

GEOMETRY = ConeGeometry(500.0, 800.0, (6, 8), (50.0, 50.0))
ANGLE_DEG = 30.0
POINT_MM = np.array([-30.0, 60.0, 40.0])  # x, y, z: off the axis and above the middle plane
_SMALL = 10.0  # font size of labels
_TITLE = 11.5


def shadow() -> tuple[float, float]:
    """Returns the row and column, as fractions, where the ray through the point meets the panel."""
    pose = GEOMETRY.pose(np.deg2rad(ANGLE_DEG))
    source, first, step_u, step_v = pose.reshape(4, 3)
    normal, ray = np.cross(step_u, step_v), POINT_MM - source
    hit = source + ((first - source) @ normal) / (ray @ normal) * ray - first
    return float(hit @ step_v / (step_v @ step_v)), float(hit @ step_u / (step_u @ step_u))


def pixels() -> tuple[tuple[int, int], tuple[int, int]]:
    """Returns row and column of the shadow in the frame, and in an image file whose row 0 is at the top."""
    row, column = (round(place) for place in shadow())
    return (row, column), (GEOMETRY.detector_shape[0] - 1 - row, column)


def conventions_figure() -> Figure:
    """Draws the gantry from above, the panel from the source and the image file, with one point and its shadow."""
    figure = Figure(figsize=(12.5, 4.3), layout="constrained")
    above, panel, file = figure.subplots(1, 3, width_ratios=(1.3, 1.2, 0.95))
    _draw_gantry(above)
    _draw_panel(panel)
    _draw_file(file)
    return figure


def _draw_gantry(axes: Axes) -> None:
    pose = GEOMETRY.pose(np.deg2rad(ANGLE_DEG))
    columns = GEOMETRY.detector_shape[1]
    source, step_u = pose[:2], pose[6:8]
    edges = [pose[3:5] + column * step_u for column in (-0.5, columns - 0.5)]
    hit = pose[3:5] + shadow()[1] * step_u
    axes.add_patch(Circle((0, 0), GEOMETRY.source_to_axis_mm, fill=False, color="0.8"))
    for edge in edges:
        axes.plot(*zip(source, edge, strict=True), color="0.75", lw=0.8)
    axes.plot(*zip(source, hit, strict=True), color=SAMPLE, lw=1)
    axes.plot(*zip(*edges, strict=True), color=ACCENT, lw=4, solid_capstyle="butt")
    axes.plot(*source, "o", color=EDGE, ms=9)
    axes.plot(*POINT_MM[:2], "o", color=SAMPLE, ms=6)
    axes.plot(*hit, "s", color=SAMPLE, ms=5)
    for end, name in (((210, 0), "x"), ((0, 210), "y")):
        _arrow(axes, (0, 0), end, "0.3")
        axes.text(*np.multiply(end, 1.12), name, ha="center", va="center", fontsize=_SMALL, color="0.3")
    axes.text(-12, -18, "axis, z\ntowards you", ha="right", va="top", fontsize=_SMALL, color="0.3")
    axes.plot(0, 0, "o", color="white", mec="0.3", ms=8)
    axes.plot(0, 0, ".", color="0.3", ms=4)
    turn = np.deg2rad(np.linspace(0, ANGLE_DEG, 31)) * 0.86
    axes.plot(575 * np.cos(turn), 575 * np.sin(turn), color=EDGE, lw=1.5)
    start, end = (575 * np.array([np.cos(t), np.sin(t)]) for t in np.deg2rad([0.8 * ANGLE_DEG, ANGLE_DEG]))
    _arrow(axes, start, end, EDGE)
    axes.plot([500, 600], [0, 0], color=EDGE, lw=0.8, ls=":")
    axes.text(605, 100, "angle θ > 0:\ncounter-\nclockwise", fontsize=_SMALL, color=EDGE, va="center")
    axes.text(*(source + (0, 45)), "source", ha="center", fontsize=_SMALL, color=EDGE)
    axes.text(*(POINT_MM[:2] + (-12, 22)), "point", ha="right", fontsize=_SMALL, color=SAMPLE)
    across, away = step_u / np.linalg.norm(step_u), -source / np.linalg.norm(source)
    place = edges[0] + 45 * away
    _arrow(axes, place, place + 190 * across, ACCENT)
    axes.text(*(place + 95 * across + 38 * away), "û", ha="center", va="center", fontsize=13, color=ACCENT)
    for edge, column, side in ((edges[0], 0, -1), (edges[1], columns - 1, 1)):
        words = f"column {column}"
        axes.text(*(edge + side * 85 * across + 25 * away), words, ha="center", va="center", fontsize=_SMALL, color=ACCENT)
    axes.set(aspect="equal", xlim=(-560, 880), ylim=(-540, 540))
    axes.set_title("the gantry, seen from above", fontsize=_TITLE)
    axes.set_axis_off()


def _draw_panel(axes: Axes) -> None:
    rows, columns = GEOMETRY.detector_shape
    marked, _ = pixels()
    _draw_pixels(axes, marked, {(0, 0): "0, 0", marked: f"{marked[0]}, {marked[1]}"})
    for row in range(rows):
        axes.text(-0.9, row, str(row), ha="center", va="center", fontsize=_SMALL)
    for column in range(columns):
        axes.text(column, -0.95, str(column), ha="center", va="center", fontsize=_SMALL)
    _arrow(axes, (-1.9, -0.3), (-1.9, 2.2), ACCENT)
    axes.text(-1.9, 2.75, "v̂ = z", ha="center", va="center", fontsize=13, color=ACCENT)
    _arrow(axes, (-0.3, -1.8), (2.2, -1.8), ACCENT)
    axes.text(2.5, -1.8, "û", ha="left", va="center", fontsize=13, color=ACCENT)
    for place, first, last, words in (
        (columns + 0.1, -0.3, rows - 0.7, "direction 1: row 0 first"),
        (columns + 1.3, rows - 0.7, -0.3, f"direction −1: row {rows - 1} first"),
    ):
        _arrow(axes, (place, first), (place, last), EDGE)
        middle = (rows - 1) / 2
        axes.text(place + 0.5, middle, words, rotation=90, ha="center", va="center", fontsize=_SMALL, color=EDGE)
    axes.text(columns + 0.7, rows - 0.1, "readout", ha="center", va="center", fontsize=_SMALL, color=EDGE)
    axes.set(aspect="equal", xlim=(-2.6, columns + 2), ylim=(-2.3, rows + 0.3))
    axes.set_title("the panel, seen from the source:\nframe[row, column]", fontsize=_TITLE)
    axes.set_axis_off()


def _draw_file(axes: Axes) -> None:
    rows, columns = GEOMETRY.detector_shape
    marked, stored = pixels()
    _draw_pixels(axes, marked, {(rows - 1, 0): "0, 0", marked: f"{stored[0]}, {stored[1]}"})
    for row in range(rows):
        axes.text(-0.9, rows - 1 - row, str(row), ha="center", va="center", fontsize=_SMALL)
    for column in range(columns):
        axes.text(column, rows - 0.1, str(column), ha="center", va="center", fontsize=_SMALL)
    axes.set(aspect="equal", xlim=(-1.3, columns - 0.3), ylim=(-2.3, rows + 0.3))
    words = f"row {stored[0]} of the file is\nrow {rows} − 1 − {stored[0]} = {marked[0]} of the frame"
    axes.text((columns - 1) / 2, -1.5, words, ha="center", va="center", fontsize=_SMALL, color=SAMPLE)
    axes.set_title("its TIFF, row 0 on top:\nimage[row, column]", fontsize=_TITLE)
    axes.set_axis_off()


def _draw_pixels(axes: Axes, marked: tuple[int, int], words: dict[tuple[int, int], str]) -> None:
    """Draws all pixels, row 0 below. ``marked`` is the shadow; ``words`` are written into the pixels (row, column)."""
    rows, columns = GEOMETRY.detector_shape
    for row, column in np.ndindex(rows, columns):
        face = SAMPLE if (row, column) == marked else EXPOSED if (row, column) in words else "white"
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=face, edgecolor="0.6", lw=0.7))
    for (row, column), text in words.items():
        ink = "white" if (row, column) == marked else "black"
        axes.text(column, row, text, ha="center", va="center", fontsize=_SMALL, color=ink)


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], color: str) -> None:
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=11, color=color, shrinkA=0, shrinkB=0))
