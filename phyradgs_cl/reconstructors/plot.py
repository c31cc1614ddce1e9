"""A result as a figure: slices, convergence, and a frame beside what the volume gives for it."""

from typing import TYPE_CHECKING

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.drawing import CURVE, draw_image, new_figure
from phyradgs_cl.errors import InputError
from phyradgs_cl.metrics import reference_on
from phyradgs_cl.metrics.slices import draw_slices
from phyradgs_cl.reconstructors.frames.pairs import FramePair, frame_pairs
from phyradgs_cl.reconstructors.frames.preprocess import Preprocessing, prepared
from phyradgs_cl.reconstructors.result import MARGIN_MM
from phyradgs_cl.runtime import Runtime

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from phyradgs_cl.reconstructors.result import Reconstruction

_LOG_FROM = 20.0  # largest over smallest value
_ROW_INCH, _SLICE_INCH, _SIDE_INCH = 3.2, 3.6, 4.4


def plot_result(
    result: "Reconstruction", scan: Scan | None, frame: int, device: str | Runtime | None
) -> "Figure":
    """The three middle slices; beside them the record over iterations and, of a scan, a frame and its residual."""
    pair, truth = None, None
    if scan is not None:
        if not isinstance(scan, Scan):
            raise InputError("scan", checks.shown(scan), "the Scan of the result, or None")
        checks.whole("frame", frame, 0, scan.frames - 1)
        rt = device if isinstance(device, Runtime) else Runtime(device)
        (pair,) = frame_pairs(rt, prepared(scan, Preprocessing()), result.volume, result.grid, [frame])
        truth = None if scan.reference is None else reference_on(result.grid, scan.reference, scan.grid)
    columns = 1 if truth is None else 3
    side = _SIDE_INCH if len(result.record) > 1 or pair is not None else 0.0
    figure = new_figure(columns * _SLICE_INCH + side, 3 * _ROW_INCH)
    if not side:
        draw_slices(figure, result.volume, truth, result.grid)
        return figure
    parts = figure.add_gridspec(1, 2, width_ratios=(columns * _SLICE_INCH, side))
    slices, beside = figure.add_subfigure(parts[0]), figure.add_subfigure(parts[1])
    draw_slices(slices, result.volume, truth, result.grid)
    curves, measured, residual = beside.subplots(3, 1)
    _convergence(curves, result.record)
    _residual(measured, residual, pair, scan, ", the margin discarded" if MARGIN_MM in result.facts else "")
    return figure


def _convergence(axes: "Axes", record: list[dict[str, float]]) -> None:
    """What the record says of how far the run is from its goal."""
    name = next((key for key in ("residual", "loss") if record and key in record[-1]), None)
    if name is None or len(record) < 2:
        axes.set_axis_off()
        return
    points = [(line["iteration"], line[name]) for line in record if name in line]
    values = [value for _, value in points]
    axes.plot(*zip(*points, strict=True), color=CURVE, lw=1.4)
    axes.set(xlabel="iteration", ylabel=name)
    if min(values) > 0 and max(values) > _LOG_FROM * min(values):
        axes.set_yscale("log")
    axes.set_title("convergence", fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)


def _residual(measured: "Axes", residual: "Axes", pair: FramePair | None, scan: Scan | None, lacks: str) -> None:
    """A measured frame, and measured less computed from a volume that ``lacks`` something."""
    if pair is None or scan is None:
        measured.set_axis_off()
        residual.set_axis_off()
        return
    (rows, columns), (dv, du) = scan.geometry.detector_shape, scan.geometry.pixel_size_mm
    size_mm, limit = (rows * dv, columns * du), float(abs(pair.residual).max()) or 1.0
    draw_image(measured, pair.measured, f"frame {pair.frame}: line integrals", size_mm=size_mm, cmap="gray")
    title = f"measured less computed{lacks}:\nRMS {100 * pair.relative:.2g} %"
    draw_image(residual, pair.residual, title, size_mm=size_mm, cmap="RdBu_r", vmin=-limit, vmax=limit)
