"""A frame of a scan, and when its lines are open."""

from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.drawing import CURVE, EDGE, EXPOSED, RESTING, draw_image, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from phyradgs_cl.acquisition.scan import Scan


def plot_frame(scan: "Scan", frame: int) -> "Figure":
    """One frame (rows, columns) of line integrals in mm on the panel, and the windows of its lines in s."""
    checks.whole("frame", frame, 0, scan.frames - 1)
    figure = new_figure(10, 4.2)
    picture, windows = figure.subplots(1, 2, width_ratios=(1, 1.1))
    image = scan.projections[frame].astype(np.float64)
    image[~scan.valid[frame]] = np.nan
    size_mm = tuple(
        n * d for n, d in zip(scan.geometry.detector_shape, scan.geometry.pixel_size_mm, strict=True)
    )
    draw_image(
        picture,
        image,
        f"frame {frame} of {scan.frames}: line integrals",
        size_mm=(size_mm[0], size_mm[1]),
        cmap="gray",
    )
    if scan.is_fly:
        draw_windows(windows, scan.shutter, scan.lines)
        turn = _turned_deg(scan, frame)
        windows.set_title(f"gantry from {turn[0]:.1f}° to {turn[1]:.1f}°", fontsize=9)
    else:
        windows.set_axis_off()
        windows.text(0.5, 0.5, "the gantry stands still", ha="center", va="center")
    return figure


def draw_windows(axes: "Axes", shutter: Shutter, lines: int) -> None:
    """When each of ``lines`` lines opens and closes, in s after the frame's start; what a pulse lights is coloured."""
    line = np.arange(lines)
    opening = shutter.delay_s(lines)
    lit = shutter.line_windows_s(lines)
    if shutter.pulse_s is not None:
        axes.fill_betweenx(
            line, opening, opening + shutter.exposure_s, color="0.88", step="mid", label="open, no beam"
        )
    axes.fill_betweenx(
        line, lit[:, 0], lit[:, 1], facecolor=EXPOSED, edgecolor=EDGE, step="mid", label="exposed"
    )
    axes.axvline(shutter.middle_s, color=RESTING, ls="--", lw=1.2, label="motion static: one pose")
    middle = lines // 2
    axes.plot(lit[middle], [middle, middle], color=CURVE, lw=2, label=f"{shutter.axis[:-1]} {middle}")
    axes.set(xlabel="time after the frame's start (s)", ylabel=shutter.axis[:-1], ylim=(-0.5, lines - 0.5))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7, loc="upper left" if shutter.direction > 0 else "lower left")


def _turned_deg(scan: "Scan", frame: int) -> tuple[float, float]:
    """The source's azimuth as a frame's first line opens, and as its last one closes."""
    times_s = scan.frame_start_s[frame] + np.array([0.0, scan.shutter.span_s])
    pose = scan.trajectory.pose(frame, times_s)
    first, last = np.rad2deg(np.unwrap(np.arctan2(pose[:, 1], pose[:, 0])))
    return float(first), float(last)
