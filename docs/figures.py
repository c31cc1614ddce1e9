"""Draws the figures of the documentation into docs/images: python docs/figures.py [NAME ...], by default all.

shutter.png        exposure and readout of one frame, and its cut into strips and sub-intervals.
exact_splat.png    line integrals of a wide Gaussian: exact and affine splat against quadrature.
time_sampling.png  error of the simulator's time samples and of micro-views against a fine average.

conventions.png    gantry, panel and image file: conventions of angle, rows and columns.

scan_plot.png      ``scan.plot``.
result_plot.png    ``result.plot``.
methods.png        one scan by five methods.
check.png          a wrong offset, and after ``check --fix-offset``.
calibrate.png      a shifted, rolled and tilted panel, and after ``calibrate``.
motion.gif         the motion ignored, then known: from the volumes of ``make demo`` in demo/ (or $DEMO).

The first four are computed on the spot in float64 and need no OpenCL device. ``make demo`` draws demo.png.
"""

import os
import sys
from pathlib import Path

import numpy as np
from conventions import conventions_figure
from examples_drawn import calibrate_figure, check_figure, methods_figure
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Polygon, Rectangle
from PIL import Image

from phyradgs_cl.acquisition import ConeGeometry, TimeCells, make_protocol
from phyradgs_cl.acquisition.cells import micro_view_cells, per_line_cells, static_cells
from phyradgs_cl.api import reconstruct, simulate
from phyradgs_cl.drawing import ACCENT, EDGE, EXPOSED, SAMPLE
from phyradgs_cl.fields import Grid
from phyradgs_cl.io import read_volume
from phyradgs_cl.metrics import psnr
from phyradgs_cl.operators.twins.splat import splat_image
from phyradgs_cl.phantoms import shepp_logan
from phyradgs_cl.simulation import AnalyticSource, default_time_samples
from phyradgs_cl.workflow import load_reference

IMAGES = Path(__file__).resolve().parent / "images"


def save(figure: Figure, name: str) -> None:
    IMAGES.mkdir(exist_ok=True)
    figure.savefig(IMAGES / name, dpi=110, metadata={"Software": None})


def shutter_figure() -> None:
    exposure, readout, strips, sub_intervals = 1.0, 0.86, 8, 5
    figure = Figure(figsize=(11, 3.8), layout="constrained")
    orbit, continuous, discrete = figure.subplots(1, 3, width_ratios=(0.8, 1, 1))
    _draw_orbit(orbit)
    corners = [(0, 0), (exposure, 0), (exposure + readout, 1), (readout, 1)]
    continuous.add_patch(Polygon(corners, facecolor=EXPOSED, edgecolor=EDGE, lw=1.2))
    continuous.plot([readout * 0.6, readout * 0.6 + exposure], [0.6, 0.6], color=SAMPLE, lw=2)
    continuous.text(
        readout * 0.6 + exposure / 2, 0.62, "one line's exposure", ha="center", va="bottom", fontsize=8
    )
    _bracket(continuous, 0, exposure, -0.07, "exposure $T_{exp}$")
    _bracket(continuous, exposure, exposure + readout, 1.05, "readout $T_{ro}$")
    continuous.set_title("what the detector does", fontsize=10)
    for strip in range(strips):
        start, low, high = (strip + 0.5) / strips * readout, strip / strips, (strip + 1) / strips
        box = [(start, low), (start + exposure, low), (start + exposure, high), (start, high)]
        discrete.add_patch(Polygon(box, facecolor=EXPOSED, edgecolor=EDGE, lw=0.8))
        times = start + (np.arange(sub_intervals) + 0.5) / sub_intervals * exposure
        discrete.plot(times, np.full(sub_intervals, (low + high) / 2), ".", color=SAMPLE, ms=5)
    discrete.add_patch(Polygon(corners, fill=False, edgecolor="0.4", lw=0.8, ls=":"))
    discrete.set_title(f"micro-views: {strips} strips × {sub_intervals} sub-intervals", fontsize=10)
    for axes in (continuous, discrete):
        middle = (exposure + readout) / 2
        axes.axvline(middle, color=ACCENT, lw=1.2, ls="--")
        axes.text(middle, 1.2, "static: mid-window", ha="center", fontsize=8, color=ACCENT)
        axes.set(xlim=(-0.1, 2.0), ylim=(-0.22, 1.3), xlabel="time (exposures)", yticks=[0, 1])
        axes.set_yticklabels(["first line", "last line"])
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, "shutter.png")


def _draw_orbit(axes: Axes) -> None:
    turn = np.linspace(0, 2 * np.pi, 181)
    axes.plot(np.cos(turn), np.sin(turn), color="0.8", lw=1)
    axes.add_patch(Arc((0, 0), 2, 2, theta1=20, theta2=20 + 14.4, color=EDGE, lw=6))
    axes.add_patch(Arc((0, 0), 2, 2, theta1=20 + 14.4, theta2=20 + 26.8, color=EXPOSED, lw=6))
    for angle_deg, alpha in ((20, 1.0), (34.4, 0.5), (46.8, 0.25)):
        angle = np.deg2rad(angle_deg)
        radial, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        source, panel = radial, -0.45 * radial
        for side in (-1, 1):
            edge = panel + side * 0.5 * across
            axes.plot([source[0], edge[0]], [source[1], edge[1]], color=ACCENT, lw=0.6, alpha=alpha)
        ends = np.stack([panel - 0.5 * across, panel + 0.5 * across])
        axes.plot(ends[:, 0], ends[:, 1], color=ACCENT, lw=3, alpha=alpha)
        axes.plot(*source, "o", color=ACCENT, ms=6, alpha=alpha)
    body = 0.25 * np.stack([np.cos(turn), np.sin(turn)], -1)
    axes.add_patch(Polygon(body, facecolor="0.85", edgecolor="0.5"))
    axes.text(0, 0, "object", ha="center", va="center", fontsize=8)
    axes.text(1.12, 0.52, "14.4° while\na line is open", fontsize=7.5, color=EDGE, ha="left", va="center")
    axes.text(
        0.85, 0.83, "12.4° more until\nthe last has closed", fontsize=7.5, color=EDGE, ha="left", va="center"
    )
    axes.set(aspect="equal", xlim=(-1.15, 1.95), ylim=(-1.15, 1.15))
    axes.set_title("the gantry never stops", fontsize=10)
    axes.set_axis_off()


def _bracket(axes: Axes, start: float, stop: float, height: float, text: str) -> None:
    axes.annotate("", (start, height), (stop, height), arrowprops={"arrowstyle": "<->", "lw": 0.8})
    below = height < 0.5
    axes.text(
        (start + stop) / 2,
        height + (-0.03 if below else 0.02),
        text,
        ha="center",
        va="top" if below else "bottom",
        fontsize=8,
    )


def splat_figure() -> None:
    """Draws one row of pixels through a wide Gaussian half-way to the edge of the volume."""
    columns, scale = 257, 0.25
    geometry = ConeGeometry(5.0, 7.0, (3, columns), (4 / columns, 4 / columns))
    pose = geometry.pose(0.0)
    rows = np.array([[0.45, 0.55, 0.0, scale, scale * 0.6, scale, 1.0, 0, 0, 0, 1.0]]).T
    exact = splat_image(rows, pose, (3, columns))[1]
    affine = splat_image(rows, pose, (3, columns), affine=True)[1]
    truth = _quadrature(rows[:, 0], pose, columns)
    u_mm = (np.arange(columns) - (columns - 1) / 2) * 4 / columns
    figure = Figure(figsize=(8.5, 3.2), layout="constrained")
    value, error = figure.subplots(1, 2)
    value.plot(u_mm, truth, color="0.6", lw=4, label="quadrature")
    value.plot(u_mm, exact, color=SAMPLE, lw=1.2, label="exact splat")
    value.plot(u_mm, affine, color=ACCENT, lw=1.2, ls="--", label="affine splat")
    value.set(xlabel="detector column (mm)", title="line integral")
    value.legend(fontsize=8)
    percent = 100 / truth.max()
    error.plot(u_mm, percent * (exact - truth), color=SAMPLE, lw=1.2)
    error.plot(u_mm, percent * (affine - truth), color=ACCENT, lw=1.2, ls="--")
    error.set(xlabel="detector column (mm)", title="error (% of the peak)")
    for axes in (value, error):
        axes.title.set_fontsize(10)
        axes.spines[["top", "right"]].set_visible(False)
    save(figure, "exact_splat.png")
    print(
        f"exact splat: worst error {np.abs(exact - truth).max() / truth.max():.1e} of the peak, "
        f"affine {np.abs(affine - truth).max() / truth.max():.1e}"
    )


def _quadrature(row: np.ndarray, pose: np.ndarray, columns: int) -> np.ndarray:
    """Returns line integrals along the middle row by 4000 midpoints per ray (the rotation is the identity)."""
    pixel = pose[3:6] + np.arange(columns)[:, None] * pose[6:9] + pose[9:12]
    ray = pixel - pose[:3]
    share = (np.arange(4000) + 0.5) / 4000
    points = pose[:3] + share[None, :, None] * ray[:, None, :]
    q = (((points - row[:3]) / row[3:6]) ** 2).sum(axis=-1)
    return row[10] * np.exp(-q / 2).mean(axis=1) * np.linalg.norm(ray, axis=1)


def sampling_figure() -> None:
    """Draws the relative RMS error of one frame against 1536 times per line: Shepp-Logan, rapid protocol."""
    count = 96
    geometry = ConeGeometry(5.0, 7.0, (count, count), (4 / count, 4 / count))
    protocol = make_protocol("rapid", start_deg=30.0)
    shutter, orbit = protocol.shutter("rows"), protocol.orbit(geometry)
    source = AnalyticSource(shepp_logan(1.0), geometry)
    where = (orbit, shutter, 0, 0.0, count)

    def frame(cells: TimeCells) -> np.ndarray:
        return source.frame(cells, "log", 1.0).astype(np.float64)

    fine = frame(per_line_cells(*where, 1536))

    def error(cells: TimeCells) -> float:
        return float(np.sqrt(np.mean((frame(cells) - fine) ** 2) / np.mean(fine**2)))

    samples = [1, 2, 3, 5, 8, 12, 17, 24, 33, 48, 65]
    per_line = [error(per_line_cells(*where, n)) for n in samples]
    strips = {m: [error(micro_view_cells(*where, m, n)) for n in samples[:7]] for m in (4, 8, 16)}
    static = error(static_cells(*where))
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.axhline(static, color=ACCENT, ls="--", lw=1, label="static, mid-window")
    for (m, values), tone in zip(strips.items(), ("#d9a520", "#c07c12", "#8a5a0a"), strict=True):
        axes.plot(samples[:7], values, ".-", color=tone, lw=1, label=f"micro-views, M = {m}")
    axes.plot(samples, per_line, ".-", color=SAMPLE, lw=1.2, label="every line at its own times")
    for voxels in (64, 128, 256):
        chosen = default_time_samples(protocol, Grid.cube(voxels, 2.0))
        axes.axvline(chosen, color="0.7", lw=0.8, ls=":")
        axes.text(chosen, static * 1.5, f"{voxels}³", ha="center", fontsize=7, color="0.4")
    axes.set(xscale="log", yscale="log", xlabel="times per line (N)", ylabel="relative RMS error of a frame")
    axes.legend(fontsize=7)
    save(figure, "time_sampling.png")


def api_figures() -> None:
    scan = simulate("foot", size=48, detector=72, noise="tigre")
    save(scan.plot(3), "scan_plot.png")
    save(reconstruct(scan, "fista-tv", motion="per-row", iterations=60).plot(scan, frame=3), "result_plot.png")


def motion_figure() -> None:
    """Draws one slice of `make demo`. A line sweeps over it, and behind the line the motion is known."""
    folder = Path(os.environ.get("DEMO", IMAGES.parents[1] / "demo"))
    truth = load_reference(folder / "scan.h5")[0].values
    ignored, known = (read_volume(folder / name).values for name in ("static.h5", "moving.h5"))
    part = round(0.28 * len(truth)), slice(round(0.28 * truth.shape[1]), None), slice(round(0.3 * truth.shape[2]), -18)
    names = f"motion ignored: {psnr(ignored, truth):.1f} dB", f"motion known: {psnr(known, truth):.1f} dB"
    frames = [_swept_frame(ignored[part].T, known[part].T, truth[part].T, names, share) for share in _sweep()]
    frames[0].save(IMAGES / "motion.gif", save_all=True, append_images=frames[1:], duration=90, loop=0, optimize=True)


def _sweep() -> np.ndarray:
    """Returns the line's positions from frame to frame, as shares of the width: a rest, forth, a rest, and back."""
    there = np.linspace(0, 1, 14)
    return np.concatenate([np.zeros(8), there, np.ones(12), there[::-1]])


def _swept_frame(
    ignored: np.ndarray, known: np.ndarray, truth: np.ndarray, names: tuple[str, str], share: float
) -> Image.Image:
    """Draws one frame: motion known left of the line, ignored right of it, on the grey scale of the truth."""
    rows, columns = truth.shape
    width, title = 7.2, 0.35  # in inches
    height = width * rows / columns
    figure = Figure(figsize=(width, height + title), dpi=100)
    axes = figure.add_axes((0.0, 0.0, 1.0, height / (height + title)))
    extent = (0.0, float(columns), 0.0, float(rows))
    for image, start, stop in ((known, 0.0, share), (ignored, share, 1.0)):
        drawn = axes.imshow(
            image, cmap="gray", vmin=0, vmax=float(truth.max()), origin="lower", extent=extent, interpolation="bicubic"
        )
        drawn.set_clip_path(Rectangle((start * columns, 0), (stop - start) * columns, rows, transform=axes.transData))
    axes.axvline(share * columns, color=ACCENT, lw=2)
    axes.set(xlim=extent[:2], ylim=extent[2:])
    axes.set_axis_off()
    figure.text(0.02, 0.945, names[1], color=SAMPLE, fontsize=12, alpha=1.0 if share > 0.15 else 0.25)
    figure.text(0.98, 0.945, names[0], color=ACCENT, fontsize=12, ha="right", alpha=1.0 if share < 0.85 else 0.25)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").quantize(112)


FIGURES = {
    "shutter": shutter_figure,
    "splat": splat_figure,
    "sampling": sampling_figure,
    "api": api_figures,
    "conventions": lambda: save(conventions_figure(), "conventions.png"),
    "methods": lambda: save(methods_figure(), "methods.png"),
    "check": lambda: save(check_figure(), "check.png"),
    "calibrate": lambda: save(calibrate_figure(), "calibrate.png"),
    "motion": motion_figure,
}


def main() -> None:
    for name in sys.argv[1:] or FIGURES:
        FIGURES[name]()


if __name__ == "__main__":
    main()
