"""Makes the sections of a report. Each function returns HTML about a run, or None if there is nothing to show."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.acquisition.motion import motion_facts, motion_in_words
from phyradgs_cl.prepare import PREPARED_KEY
from phyradgs_cl.reconstructors.projected import TIMES_PER_LINE, FramePair
from phyradgs_cl.report import images, scan_charts
from phyradgs_cl.report.atlas import has_depth, space
from phyradgs_cl.report.charts import Chart, convergence_charts, histogram, profile_chart, views_chart
from phyradgs_cl.report.markup import Markup, element, joined, label, number, shown, unit
from phyradgs_cl.report.motion import frame_in_motion, object_in_motion
from phyradgs_cl.report.run import Change, Run
from phyradgs_cl.report.viewer import stills, viewer
from phyradgs_cl.text import flattened, to_digits_of

# Limits of a page's content, since a file may hold more.
_MOST_ROWS = 400  # at most this many rows of a table are shown
_STATES = 5  # a changing object is shown at this many times
_MOST_CHARTS = 6  # at most this many charts of a calibration are shown
_MOST_COMBINATIONS = 20  # at most this many combinations of parameters that a calibration cannot tell apart are shown
_ABSURD = 1e9  # larger parameters come from damaged files and are not rounded


def slices_section(run: Run) -> Markup:
    """Shows slices of the volume, and of the true volume if the scan has one."""
    stored, grid = run.stored, run.stored.required_grid
    windows = images.windows_of(stored.values, run.reference, stored.doubt)
    planes = images.planes_of(stored.values, run.reference, grid, windows, stored.doubt)
    size = " × ".join(number(side) for side in grid.size_mm)
    words = f"{' × '.join(map(str, grid.shape))} voxels (z, y, x), {size} mm"
    if any(len(plane.indices) < plane.count for plane in planes):
        words += "; the page has evenly chosen slices of them"
    if not has_depth(stored.values):
        words += "; there is no picture in 3D of a volume one voxel thick"
    return section("slices", "Slices", note(words + "."), viewer(planes, windows))


def doubt_section(run: Run) -> Markup | None:
    """Shows a profile through the volume's middle with its error bars, and the true volume's profile if the scan has one."""
    stored = run.stored
    if stored.doubt is None:
        return None
    z, y = (n // 2 for n in stored.values.shape[:2])
    truth = None if run.reference is None else run.reference[z, y]
    drawing = profile_chart(stored.required_grid.axes_mm()[2], stored.values[z, y], stored.doubt[z, y], truth)
    words = "Made so that 68 % of the object's voxels are within σ of the truth: over a volume, not for one strange "
    words += "detail; what no ray sees is the prior's belief. Among the slices σ is the layer Error bar."
    caption = f"Along x through the middle, with a band of one σ{'' if truth is None else '; dashed, the truth'}."
    return section("doubt", "Error bars", note(words), _charts([(caption, drawing)]))


def states_section(run: Run) -> Markup | None:
    """Shows the middle slices of a changing object at some times."""
    if (states := run.stored.states) is None:
        return None
    high = max(images.grey_range(state)[1] for state in states.volumes)
    parts = [note(f"The volume is the mean of {len(states.times_s)} states. Some of them, in middle slices:")]
    for k in np.unique(np.linspace(0, len(states.times_s) - 1, _STATES).round().astype(int)).tolist():
        slices = images.middle_slices(states.volumes[k])
        planes = images.middle_planes(slices, run.stored.required_grid, (0.0, high))
        parts += [element("h3", f"{number(float(states.times_s[k]))} s"), stills(planes, f"state {k + 1}", high)]
    return section("states", "States", *parts)


def motion_section(run: Run) -> Markup | None:
    """Shows the object at any time of the scan, if its motion is known."""
    if run.deformation is None or not has_depth(run.stored.values):
        return None
    stored, grid, field = run.stored, run.stored.required_grid, run.deformation
    span_s = float(field.times_s[0]), float(field.times_s[-1])
    if run.scan is not None:
        starts_s = run.scan.frame_start_s
        span_s = float(starts_s[0]), float(starts_s[-1]) + run.scan.shutter.lit_span_s[1]
    limit_mm = float((np.abs(field.weights) @ field.reach_mm).max())
    words = f"The volume is one state of the object, the reference. Matter moves by less than {number(limit_mm)} mm from it."
    window = images.windows_of(stored.values, run.reference)["result"]
    return section("motion", "Motion", note(words), object_in_motion(stored.values, grid, window, field, span_s))


def volume_section(run: Run) -> Markup | None:
    """Shows the volume in 3D. The section is hidden until the script finds that the browser can draw it."""
    stored = run.stored
    window = images.windows_of(stored.values, run.reference)["result"]
    picture = space(stored.values, stored.required_grid, window, stored.gaussians)
    return None if picture is None else section("volume", "Volume in 3D", picture, hidden=True)


def metrics_section(run: Run, views: Sequence[FramePair]) -> Markup | None:
    """Shows errors of the volume against the true volume, and of computed frames, if any, against the measured ones."""
    facts: dict[str, object] = dict(run.metrics)
    if run.reference is not None:
        error = run.stored.values.astype(np.float64) - run.reference
        facts["root_mean_square_error_per_mm"] = float(np.sqrt(np.mean(error**2)))
        facts["mean_error_per_mm"] = float(np.mean(error))
    if views:
        facts["residual_of_the_shown_frames"] = float(np.sqrt(np.mean([view.rms**2 for view in views])))
    if not facts:
        return None
    words = f"Against the reference of the scan, {run.compared}. " if run.compared else ""
    if "holdout_rms" in facts:
        words += "Holdout: RMS error of line integrals that the method did not see, and the RMS of their noise."
    return section("metrics", "Metrics", words and note(words), facts_table(facts))


def convergence_section(run: Run) -> Markup | None:
    charts = convergence_charts(run.record)
    return section("convergence", "Convergence", _charts(charts)) if charts else None


def scan_section(run: Run) -> Markup:
    facts = {k: v for k, v in run.scan_facts.items() if k != "sha256"}
    return section("scan", "Scan", element("div", facts_table(facts), class_="columns"))


def geometry_section(scan: Scan) -> Markup:
    source, beam = ("where the rays come from", "parallel rays") if scan.is_parallel else ("the source", "cone")
    above = f"From above: {source} in the middle of every frame"
    above += ", and its arc in the first frame; grey, the panel at the end of the arc." if scan.is_fly else "."
    side = f"From the side: the {beam} of the first frame."
    charts = [(above, scan_charts.orbit_chart(scan)), (side, scan_charts.side_chart(scan))]
    return section("geometry", "Geometry", _charts(charts))


def shutter_section(run: Run, scan: Scan) -> Markup | None:
    """Shows when a frame's lines are exposed, and successive frames of a fly-scan; None where no exposure is stated."""
    if not scan.is_fly and scan.shutter.exposure_s == 0:
        return None
    words = scan_charts.shutter_words(scan)
    caption = f"{words[0].upper()}{words[1:]}."
    if run.motion is not None:
        caption += f" {_motion_words(scan, run.motion)}"
    charts, motion = [(caption, scan_charts.shutter_chart(scan, run.motion))], None
    if scan.is_fly:
        charts.append(("The first frames on one axis of time.", scan_charts.frames_chart(scan)))
        motion = element("div", frame_in_motion(scan), class_="scripted-only")
    return section("shutter", "Shutter in space and time", _charts(charts), motion)


def projections_section(scan: Scan, views: Sequence[FramePair]) -> Markup | None:
    """Shows measured, computed and residual frames. All frames share their grey values, and all residuals."""
    if not views:
        return None
    (rows, columns), (dv_mm, du_mm) = scan.geometry.detector_shape, scan.geometry.pixel_size_mm
    words, parts = frame_pictures(views, f"aspect-ratio: {columns * du_mm:.6g} / {rows * dv_mm:.6g}")
    if scan.is_fly:
        words += f" Every line is computed from the volume at {TIMES_PER_LINE} times of its own exposure."
    else:
        words += " Every frame is computed from its one pose."
    return section("projections", "Projections", note(words), *parts)


def frame_pictures(views: Sequence[FramePair], style: str | None = None) -> tuple[str, list[Markup]]:
    """Returns the legend of frames, and a row of pictures for each. style: CSS, for pixels that are not square."""
    low = min(0.0, *(float(v.measured.min()) for v in views))
    high = max(float(v.measured.max()) for v in views)
    limit = max(float(np.percentile(np.abs(v.residual), 99.5)) for v in views) or 1.0
    words = f"Line integrals, black {number(low)}, white {number(high)}; residuals, measured less computed, "
    words += f"blue −{number(limit)}, red +{number(limit)}."
    parts = []
    for view in views:
        residual = f"residual, RMS {number(view.rms)} ({number(100 * view.relative)} %)"
        pictures = [
            ("measured", images.grey_png(view.measured, low, high)),
            ("computed", images.grey_png(view.computed, low, high)),
            (residual, images.signed_png(view.residual, limit)),
        ]
        parts.append(_row(f"Frame {view.frame}", f"frame {view.frame}", pictures, style))
    return words, parts


def preparation_section(run: Run, changes: Sequence[Change]) -> Markup | None:
    """Shows the effect of each preprocessing step by pictures, a histogram and numbers; steps of ``phyradgs prepare`` by
    numbers only, because the frames before are not in the file."""
    prepared = [] if run.scan is None else run.scan.provenance.get(PREPARED_KEY)
    earlier = [element("div", element("h3", str(line.get("step"))), facts_table(line)) for line in _tables(prepared)]
    if not changes and not earlier:
        return None
    words = "The frame and the sinogram (a line per frame) that each step changed most, and the middle slice. Before and "
    words += "after have one range of grey values; the difference is after less before."
    return section("preparation", "Preparation", changes and note(words), *earlier, *map(_change, changes))


def _change(change: Change) -> Markup:
    parts = []
    for name, (before, after) in change.pairs.items():
        low, high, difference = float(before.min()), float(before.max()), after - before
        limit = float(np.percentile(np.abs(difference), 99.9)) or float(np.abs(difference).max()) or 1.0
        pictures = [
            ("before", images.grey_png(before, low, high)),
            ("after", images.grey_png(after, low, high)),
            (f"difference, ±{number(limit)}", images.signed_png(difference, limit)),
        ]
        parts.append(_row(f"{change.step}: {name}", f"{change.step}, {name}", pictures))
    caption = "Line integrals of all frames: dashed before, solid after."
    return joined(*parts, _charts([(caption, histogram(change.edges, change.counts))]), facts_table(change.numbers))


def calibration_section(scan: Scan) -> Markup | None:
    """Shows the results of ``calibrate``, in the order in which it was run: tables of parameters, charts over views."""
    calibrations = _tables(scan.provenance.get("calibrated_before")) + _tables([scan.provenance.get("calibration")])
    parts = [part for one in calibrations for part in _calibration(one, scan)]
    if not parts:
        return None
    words = "Parameters of the scan were estimated from its frames"
    words += f", {len(calibrations)} times, each from the result before." if len(calibrations) > 1 else "."
    return section("calibration", "Calibration", note(words), *parts)


def _calibration(calibration: Mapping[str, object], scan: Scan) -> list[Markup]:
    """Returns a table of parameters, combinations of parameters that frames cannot tell apart, and charts over the views."""
    parameters = _tables(calibration.get("parameters"))
    if not parameters:
        return []
    names = ("parameter", "stated", "found", "verdict")
    head = element("tr", *(element("th", name, scope="col") for name in names))
    rows = [element("tr", *(element("td", cell) for cell in _cells(line))) for line in parameters[:_MOST_ROWS]]
    before, after = (_or_dash(calibration.get(f"residual_rms_{when}")) for when in ("before", "after"))
    notes = [f"Residual of the frames: {before} before, {after} after (RMS)."]
    combinations, views = calibration.get("alike"), calibration.get("views")
    if isinstance(combinations, list):
        notes += [f"Cannot be told apart: {shown(words)}." for words in combinations[:_MOST_COMBINATIONS]]
    corrections = list(views.items())[:_MOST_CHARTS] if isinstance(views, Mapping) else []
    charts = [views_chart(k, v) for k, v in corrections if isinstance(v, list) and len(v) == scan.frames]
    return [
        element("table", element("thead", head), element("tbody", *rows)),
        *map(note, notes),
        _charts(chart for chart in charts if chart is not None),
    ]


def _cells(line: Mapping[str, object]) -> list[str]:
    estimate, deviation, unit_name = line.get("found"), line.get("deviation"), line.get("unit")
    of = unit_name if isinstance(unit_name, str) else ""
    value = "–" if estimate is None else f"{shown(estimate)} ± {_or_dash(deviation, of)}"
    if isinstance(estimate, float) and isinstance(deviation, float) and abs(estimate) + deviation < _ABSURD:
        value = f"{to_digits_of(estimate, deviation)} ± {shown(to_digits_of(deviation, deviation), of)}"
    return [_or_dash(line.get("name")), _or_dash(line.get("stated"), of), value, _or_dash(line.get("verdict"))]


def provenance_section(run: Run) -> Markup:
    """Shows all that the volume file says about how it was made, except the convergence record."""
    facts = {k: v for k, v in run.stored.provenance.items() if k not in ("record", "options")}
    options = run.stored.provenance.get("options")
    parts: list[object] = [facts_table(facts)]
    if isinstance(options, Mapping):
        summary = element("summary", "All options of the method")
        parts.append(element("details", summary, facts_table(options)))
    return section("provenance", "Provenance", *parts)


def facts_table(facts: Mapping[str, object]) -> Markup:
    cells = [(label(key), shown(value, unit(key))) for key, value in list(flattened(facts))[:_MOST_ROWS]]
    lines = [element("tr", element("th", name, scope="row"), element("td", value)) for name, value in cells]
    return element("table", element("tbody", *lines))


def _motion_words(scan: Scan, motion: Motion) -> str:
    times_s, lines = scan_charts.pose_times(scan, motion)
    if motion.cells(scan, 0).is_moving:
        words = "dashed lines bound the segments in which Gaussians move"
    elif lines is not None:
        words = "dots are the poses of some of the lines"
    else:
        words = "dashed lines are the times of poses of all lines" if len(times_s) > 1 else "the dashed line is the one pose"
    return f"The run's motion is {motion_in_words(motion_facts(motion))}: {words}."


def _tables(value: object) -> list[Mapping[str, object]]:
    """Returns the tables in ``value``, a list read from a file; [] if it is no list."""
    return [line for line in value if isinstance(line, Mapping)] if isinstance(value, list) else []


def _or_dash(value: object, unit_name: str = "") -> str:
    return "–" if value is None else shown(value, unit_name)


def _row(heading: str, of: str, pictures: Sequence[tuple[str, bytes]], style: str | None = None) -> Markup:
    figures = []
    for words, png in pictures:
        image = element("img", src=images.data_uri(png), alt=f"{of}, {words}", style=style)
        figures.append(element("figure", element("div", image, class_="picture"), element("figcaption", words)))
    return element("div", element("h3", heading), *figures, class_="view")


def _charts(charts: Iterable[Chart]) -> Markup:
    figures = [element("figure", drawing, element("figcaption", words)) for words, drawing in charts]
    return element("div", *figures, class_="charts")


def note(words: str) -> Markup:
    """Returns a paragraph in small print."""
    return element("p", words, class_="note")


def section(identifier: str, heading: str, *content: object, hidden: bool = False) -> Markup:
    """Returns a section with its heading, without content that is empty or None."""
    title = element("h2", heading, id=f"{identifier}-heading")
    body = joined(*(part for part in content if part))
    return element("section", title, body, id=identifier, aria_labelledby=f"{identifier}-heading", hidden=hidden)
