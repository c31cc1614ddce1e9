"""Draws a result: slices, convergence, and a measured frame with its residual."""

from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector import without_lag
from phyradgs_cl.drawing import draw_curve, draw_image, new_figure
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, States
from phyradgs_cl.metrics import reference_on
from phyradgs_cl.metrics.quality import draw_slices
from phyradgs_cl.reconstructors.projected import frame_pairs
from phyradgs_cl.runtime import Runtime

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ROW_INCH, _SLICE_INCH, _SIDE_INCH = 3.2, 3.6, 4.4


def plot_result(
    volume: np.ndarray, grid: Grid, record: list[dict[str, float]], scan: Scan | None, frame: int,
    device: str | Runtime | None, note: str, moves: Deformation | States | None = None
) -> "Figure":
    """Returns a figure of the middle slices of a volume (nz, ny, nx) in 1/mm, of the convergence ``record`` and, with a
    scan, of frame number ``frame`` and its residual. A reference of the scan is added if it can be brought onto ``grid``.

    device: projects the volume for the residual. note: text added to the residual's title. moves: how the object moves or
    changes. Raises InputError for a scan that is no Scan, and for a frame out of range."""
    if not (scan is None or isinstance(scan, Scan)):
        raise InputError("scan", checks.short_repr(scan), "the Scan of the result, or None")
    truth = None
    if scan is not None:
        checks.whole("frame", frame, 0, scan.frames - 1)
        truth = None if scan.reference is None else reference_on(grid, scan.reference, scan.grid)
    columns = 1 if truth is None else 3
    if scan is None and len(record) < 2:
        figure = new_figure(columns * _SLICE_INCH, 3 * _ROW_INCH)
        draw_slices(figure, volume, truth, grid)
        return figure
    figure = new_figure(columns * _SLICE_INCH + _SIDE_INCH, 3 * _ROW_INCH)
    parts = figure.add_gridspec(1, 2, width_ratios=(columns * _SLICE_INCH, _SIDE_INCH))
    draw_slices(figure.add_subfigure(parts[0]), volume, truth, grid)
    convergence, measured, residual = figure.add_subfigure(parts[1]).subplots(3, 1)
    _draw_record(convergence, record)
    if scan is None:
        measured.set_axis_off()
        residual.set_axis_off()
    else:
        rt = device if isinstance(device, Runtime) else Runtime(device)
        (pair,) = frame_pairs(rt, without_lag(scan), volume, grid, [frame], moves)
        (rows, columns), (dv_mm, du_mm) = scan.geometry.detector_shape, scan.geometry.pixel_size_mm
        size_mm, limit = (rows * dv_mm, columns * du_mm), float(abs(pair.residual).max()) or 1.0
        draw_image(measured, pair.measured, f"frame {frame}: line integrals", size_mm=size_mm, cmap="gray")
        title = f"measured less computed{note}:\nRMS {100 * pair.relative:.2g} %"
        draw_image(residual, pair.residual, title, size_mm=size_mm, cmap="RdBu_r", vmin=-limit, vmax=limit)
    return figure


def _draw_record(axes: "Axes", record: list[dict[str, float]]) -> None:
    """Draws the record's residual, or its loss if it has none, over the iterations; nothing for fewer than two lines."""
    name = next((key for key in ("residual", "loss") if record and key in record[-1]), None)
    if name is None or len(record) < 2:
        axes.set_axis_off()
        return
    lines = [line for line in record if name in line]
    draw_curve(axes, [line["iteration"] for line in lines], [line[name] for line in lines], "iteration", name)
    axes.set_title("convergence", fontsize=9)
