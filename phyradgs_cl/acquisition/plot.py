"""Figures of a scan: a frame, and when its lines are exposed."""

from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition.geometry import towards_source
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.drawing import ACCENT, EDGE, EXPOSED, FAINT, SAMPLE, SOFT, draw_image, new_figure, style_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from phyradgs_cl.acquisition.scan import Scan

_MOST_CORNERS = 129  # most lines whose opening and closing make the outline of the exposures: a panel may have thousands


def plot_frame(scan: "Scan", frame: int = 0) -> "Figure":
    """Draws one frame's line integrals (rows, columns) with the panel's size in mm. Beside them it draws when each line is
    exposed, in s.

    Raises InputError for a frame number out of range."""
    checks.whole("frame", frame, 0, scan.frames - 1)
    figure = new_figure(10, 4.2)
    picture, windows = figure.subplots(1, 2, width_ratios=(1, 1.1))
    image = scan.projections[frame].astype(np.float64)
    image[~scan.valid[frame]] = np.nan
    rows, columns = scan.geometry.detector_shape
    dv_mm, du_mm = scan.geometry.pixel_size_mm
    title = f"frame {frame} of {scan.frames}: line integrals"
    draw_image(picture, image, title, size_mm=(rows * dv_mm, columns * du_mm), cmap="gray")
    if not scan.is_fly:
        windows.set_axis_off()
        windows.text(0.5, 0.5, "the gantry stands still", ha="center", va="center")
        return figure
    shutter, middle = scan.shutter, scan.lines // 2
    draw_windows(windows, shutter, scan.lines)
    windows.axvline(shutter.middle_s, color=ACCENT, ls="--", lw=1.2, label="motion static: one pose")
    lit_s = shutter.line_windows_s(scan.lines)[middle]
    windows.plot(lit_s, [middle, middle], color=SAMPLE, lw=2, label=f"{shutter.axis[:-1]} {middle}")
    windows.set_ylim(-0.5, scan.lines - 0.5)
    windows.legend(fontsize=7, loc="upper left" if shutter.direction > 0 else "lower left")
    poses = scan.trajectory.pose(frame, scan.frame_start_s[frame] + np.array([0.0, shutter.span_s]))
    source = towards_source(poses, scan.is_parallel)
    first_deg, last_deg = np.rad2deg(np.unwrap(np.arctan2(source[:, 1], source[:, 0])))
    windows.set_title(f"gantry from {first_deg:.1f}° to {last_deg:.1f}°", fontsize=9)
    return figure


def draw_windows(axes: "Axes", shutter: Shutter, lines: int, start_s: float = 0.0) -> None:
    """Draws when each line is exposed, in s, for a frame that starts at ``start_s``. With a pulsed beam it also draws when
    lines are open without light."""
    line = np.unique(np.linspace(0, lines - 1, _MOST_CORNERS).round().astype(int))
    lit_s = shutter.line_windows_s(lines)[line] + start_s
    if shutter.pulse_s is not None:
        open_s = shutter.delay_s(lines)[line] + start_s
        shape = _outline(open_s, open_s + shutter.exposure_s, line)
        axes.fill(*shape, facecolor=FAINT, edgecolor=SOFT, ls=":", label="open, no beam")
    axes.fill(*_outline(lit_s[:, 0], lit_s[:, 1], line), facecolor=EXPOSED, edgecolor=EDGE, alpha=0.8, label="exposed")
    style_axes(axes, "time after the frame's start (s)", f"detector {shutter.axis[:-1]}")


def _outline(first_s: np.ndarray, last_s: np.ndarray, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([first_s, last_s[::-1]]), np.concatenate([line, line[::-1]])
