"""One frame of a fly-scan in motion: its lines at their own poses, as data for the page's script."""

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, Scan
from phyradgs_cl.report.interactive.viewer import slider
from phyradgs_cl.report.markup import Markup, element, joined, json_block, number
from phyradgs_cl.report.scan_charts import box_corners, with_sources

_TIMES = 49  # at which the scanner's pose is given; the script interpolates
_MOST_LINES = 64
_STEPS = 500  # of the slider
_LOOK_DEG = 125  # from the source to the eye, about the axis: behind the panel, and to one side
_TILT_DEG = 28
_HELP = (
    "Lines that wait are thin and grey, exposed ones gold, with the rays of the first and the last. A line that has been "
    "read is blue, and stays where the panel was in the middle of its exposure. Drag, or press arrow keys here, to turn."
)


def frame_in_motion(scan: Scan) -> Markup:
    """Returns a picture of the first frame of a fly-scan, a slider of its time and the data of the script."""
    first_s, last_s = scan.shutter.lit_span_s
    times_s = np.linspace(first_s, last_s, _TIMES)
    poses = with_sources(scan, scan.trajectory.pose(0, scan.frame_start_s[0] + times_s))
    lines = np.unique(np.linspace(0, scan.lines - 1, min(scan.lines, _MOST_LINES)).round().astype(int))
    opens_s = scan.shutter.delay_s(scan.lines)[lines]
    source = poses[0, :3]
    facts = {
        "poses": np.round(poses, 5).tolist(), "times_s": [first_s, last_s], "lines": lines.tolist(),
        "opens_s": scan.shutter.in_pulse(opens_s).tolist(),
        "closes_s": scan.shutter.in_pulse(opens_s + scan.shutter.exposure_s).tolist(),
        "shape": scan.geometry.detector_shape, "axis": scan.shutter.axis, "angles_deg": _angles_deg(scan, times_s),
        "box": np.round(box_corners(scan), 5).tolist(), "steps": _STEPS, "is_parallel": scan.is_parallel,
        "turn_deg": -90 - np.rad2deg(np.arctan2(source[1], source[0])) - _LOOK_DEG, "tilt_deg": _TILT_DEG,
    }  # fmt: skip
    words = f"The first frame in motion, {number(last_s - first_s)} s"
    canvas = element(
        "canvas", id="rows", tabindex=0, role="img", aria_label=words, aria_describedby="rows-help rows-reading"
    )
    controls = [
        element("button", "Play", type="button", id="rows-play"),
        element("button", "Reset", type="button", id="rows-reset"),
        slider("rows-time", "Time", 0, _STEPS, _STEPS, ""),
    ]
    return joined(
        element("h3", words), element("div", *controls, class_="tools"),
        element("div", canvas, class_="rows"), element("p", element("output", id="rows-reading"), class_="note help"),
        element("p", _HELP, class_="note help", id="rows-help"), json_block("rows-data", facts),
    )


def _angles_deg(scan: Scan, times_s: np.ndarray) -> list[list[float]] | None:
    """Returns the gantry's angle at times (T,) within the first frame as (T, 1), or None where it is on no circle."""
    if not isinstance(scan.trajectory, CircularOrbit):
        return None
    angles_rad = scan.trajectory.angle_rad(0, scan.frame_start_s[0] + times_s)
    angles_deg: list[list[float]] = np.rad2deg(angles_rad)[:, None].tolist()
    return angles_deg
