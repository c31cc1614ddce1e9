"""Makes the report's pictures of motion. One shows a fly-scan's frame in which each detector line has its own pose. The
other shows slices of a moving object at any time of the scan, with arrows of its displacement.

The page has the object's voxels once, at the resolution of the 3D picture, and the deformation as control points. The
script computes the object at time t and point y as v(y + w(y, t)), from the voxels v and the displacement w, trilinearly."""

import numpy as np
from numpy.typing import NDArray

from phyradgs_cl.acquisition import CircularOrbit, Scan
from phyradgs_cl.fields import Deformation, Grid, deformed, triple
from phyradgs_cl.fields.deformation import fitted_control_mm
from phyradgs_cl.report.atlas import MOST_EDGE
from phyradgs_cl.report.images import Plane, Window, base64_of, block_means, middle_planes, middle_slices
from phyradgs_cl.report.markup import Markup, element, joined, json_block, number
from phyradgs_cl.report.scan_charts import box_corners, with_sources
from phyradgs_cl.report.viewer import decimals_of, picture, plane_slider, slider

_TIMES = 49  # times at which the page has the scanner's pose; the script interpolates between them
_MOST_LINES = 64  # more detector lines would merge in the picture
_FRAME_STEPS = 500  # steps of the slider for the time within a frame
_LOOK_DEG = 125  # the viewer stands this far around the axis from the source: behind the panel, to one side
_TILT_DEG = 28  # the viewer looks down by this angle
_FRAME_HELP = (
    "Lines that wait are thin and grey, exposed ones gold, with the rays of the first and the last. A line that has been "
    "read is blue, and stays where the panel was in the middle of its exposure. Drag, or press arrow keys here, to turn."
)
MOST_VALUES = 150_000  # most numbers in the page's control points, of 2 bytes each: about 0.4 MB of base64
_MOST_TIMES = 2000  # limit of the times at which the page has the deformation's weights
_STEPS = 200  # steps of the slider for the object's time
_MOST_LENGTH = 10  # users may lengthen arrows by up to this factor
_LARGEST = 32767  # largest signed number of 16 bits
_HELP = (
    "An arrow ends where matter is, and begins where the same matter is in the reference volume; black parts have none. "
    "Play, or arrow keys on the slider of the time, go through the scan. A click in a picture moves the other two slices."
)


def frame_in_motion(scan: Scan) -> Markup:
    """Returns a picture of a fly-scan's first frame, a slider for the time within it, and the script's data."""
    first_s, last_s = scan.shutter.lit_span_s
    times_s = np.linspace(first_s, last_s, _TIMES)
    poses = with_sources(scan, scan.trajectory.pose(0, scan.frame_start_s[0] + times_s))
    lines = np.unique(np.linspace(0, scan.lines - 1, min(scan.lines, _MOST_LINES)).round().astype(int))
    opens_s = scan.shutter.delay_s(scan.lines)[lines]
    source, angles_deg = poses[0, :3], None
    if isinstance(scan.trajectory, CircularOrbit):
        angles_deg = np.rad2deg(scan.trajectory.angle_rad(0, scan.frame_start_s[0] + times_s))[:, None].tolist()
    facts = {
        "poses": np.round(poses, 5).tolist(), "times_s": [first_s, last_s], "lines": lines.tolist(),
        "opens_s": scan.shutter.in_pulse(opens_s).tolist(),
        "closes_s": scan.shutter.in_pulse(opens_s + scan.shutter.exposure_s).tolist(),
        "shape": scan.geometry.detector_shape, "axis": scan.shutter.axis, "angles_deg": angles_deg,
        "box": np.round(box_corners(scan), 5).tolist(), "steps": _FRAME_STEPS, "is_parallel": scan.is_parallel,
        "turn_deg": -90 - np.rad2deg(np.arctan2(source[1], source[0])) - _LOOK_DEG, "tilt_deg": _TILT_DEG,
    }  # fmt: skip
    words = f"The first frame in motion, {number(last_s - first_s)} s"
    reading = "rows-help rows-reading"
    canvas = element("canvas", id="rows", tabindex=0, role="img", aria_label=words, aria_describedby=reading)
    controls = [*_buttons("rows"), slider("rows-time", "Time", 0, _FRAME_STEPS, _FRAME_STEPS, "")]
    return joined(
        element("h3", words), element("div", *controls, class_="tools"),
        element("div", canvas, class_="rows"), element("p", element("output", id="rows-reading"), class_="note help"),
        element("p", _FRAME_HELP, class_="note help", id="rows-help"), json_block("rows-data", facts),
    )


def _buttons(of: str) -> list[Markup]:
    return [element("button", word, type="button", id=f"{of}-{word.lower()}") for word in ("Play", "Reset")]


def object_in_motion(
    volume: NDArray[np.floating], grid: Grid, window: Window, deformation: Deformation, span_s: tuple[float, float]
) -> Markup:
    """Returns three slices of the object at the start of ``span_s``, their controls and the script's data.

    The script shows any time of the span. volume (nz, ny, nx): the reference, at least two voxels thick."""
    means = block_means(volume, MOST_EDGE)
    small = grid.in_shape(triple(means.shape))
    first = deformed(means, small, deformation, deformation.weights_at(span_s[0])[0])
    planes = middle_planes(middle_slices(first), small, (window.low, window.high))
    time = slider("motion-time", "Time", 0, _STEPS, 0, f"{number(span_s[0])} s")
    controls = [*_buttons("motion"), time, slider("motion-arrows", "Arrows", 0, _MOST_LENGTH, 1, "1×")]
    legend = f"The object at {number(span_s[0])} s, the first of {number(span_s[1] - span_s[0])} s."
    data = _data(fitting(deformation, small), small, span_s)
    return joined(
        element("div", *controls, class_="tools"), element("div", *map(_figure, planes), class_="slices"),
        element("p", element("output", legend, id="motion-reading"), class_="note"),
        element("p", _HELP, class_="note help"), json_block("motion-data", data),
    )


def fitting(deformation: Deformation, grid: Grid) -> Deformation:
    """Returns the deformation in at most ``MOST_VALUES`` numbers: a larger one is fitted by fewer control points."""
    spacing_mm, reduced = float(np.max(deformation.spacing_mm)), deformation
    while reduced.control_mm.size > MOST_VALUES and spacing_mm < 2 * max(grid.size_mm):
        spacing_mm *= 1.25
        fields_mm = np.stack([deformation.on_grid_mm(grid, unit) for unit in np.eye(deformation.rank)])
        control_mm, origin_mm = fitted_control_mm(fields_mm, grid, spacing_mm)
        reduced = Deformation(control_mm, origin_mm, spacing_mm, deformation.times_s, deformation.weights)
    return reduced


def _data(deformation: Deformation, grid: Grid, span_s: tuple[float, float]) -> dict[str, object]:
    """Returns the deformation for the script, axes x, y, z. Control points are 16-bit multiples of each field's unit."""
    control_mm = deformation.control_mm
    largest_mm = np.abs(control_mm).max(axis=(1, 2, 3, 4))
    units_mm = np.where(largest_mm > 0, largest_mm, 1.0) / _LARGEST
    whole = np.rint(control_mm / units_mm[:, None, None, None, None]).astype("<i2")
    times_s = deformation.times_s
    if len(times_s) > _MOST_TIMES:
        times_s = np.linspace(*span_s, _MOST_TIMES)
    weights = deformation.weights_at(times_s)
    return {
        "control": base64_of(whole.tobytes()), "units_mm": units_mm.tolist(), "shape": control_mm.shape[3:0:-1],
        "origin_mm": deformation.origin_mm, "spacing_mm": deformation.spacing_mm,
        "times_s": [float(f"{time_s:.9g}") for time_s in times_s],
        "weights": [[float(f"{weight:.6g}") for weight in row] for row in weights],
        "first_mm": grid.first_centre_mm[::-1], "step_mm": grid.voxel_size_mm[::-1], "span_s": span_s,
        "decimals": decimals_of(min(grid.voxel_size_mm)) + 1,
    }  # fmt: skip


def _figure(plane: Plane) -> Markup:
    axis, shown = plane.axis, picture(plane, "moving object", canvases=2)
    parts = plane_slider(plane, f"motion-slice-{axis}", f"motion-place-{axis}", plane.count - 1, plane.indices[0])
    return element("figure", shown, *parts, id=f"motion-{axis}", data_right=plane.right, data_up=plane.up)
