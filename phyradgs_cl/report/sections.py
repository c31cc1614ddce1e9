"""The sections of a page, each from a run to HTML; a section that has nothing to show is None."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from phyradgs_cl.acquisition import Exact, LineMiddles, MicroViews, Motion, OwnTimes, PerRow, Scan
from phyradgs_cl.acquisition.motion import motion_facts
from phyradgs_cl.prepare import PREPARED_KEY
from phyradgs_cl.reconstructors.frames.pairs import TIMES_PER_LINE, FramePair
from phyradgs_cl.report.charts import Chart, convergence_charts, histogram, tuning_chart, views_chart
from phyradgs_cl.report.comparisons import Change
from phyradgs_cl.report.images import (
    Plane,
    bytes_of,
    data_uri,
    diverging,
    grey_range,
    planes_of,
    png_bytes,
    stills_of,
    top_row_first,
    windows_of,
)
from phyradgs_cl.report.markup import Markup, element, flattened, joined, label, number, shown, unit
from phyradgs_cl.report.run import Run
from phyradgs_cl.report.scan_charts import frames_chart, orbit_chart, shutter_chart, shutter_words, side_chart
from phyradgs_cl.report.viewer import stills, viewer
from phyradgs_cl.text import to_digits_of

_MOST_ROWS = 400  # of provenance
_MOST_CHARTS, _MOST_ALIKE = 6, 20  # of a calibration
_ABSURD = 1e9  # a value of a parameter that no file of ours has
_DISAGREEMENT = (
    "Half the RMS of their difference over 3³ voxels, in the middle slices: where the volume leans on its method. It is no "
    "confidence interval: both are estimates from the same frames, errors that they share are not in it, and the volume's "
    "error is larger, where we measured it 1.5 to 3.5 times."
)


def slices_section(run: Run) -> Markup:
    """The volume, or the volume against the truth."""
    stored = run.stored
    windows = windows_of(stored.values, run.reference)
    planes = planes_of(stored.values, run.reference, stored.required_grid, windows)
    size = " × ".join(number(side) for side in stored.required_grid.size_mm)
    told = f"{' × '.join(map(str, stored.required_grid.shape))} voxels (z, y, x), {size} mm"
    left_out = any(len(plane.indices) < plane.count for plane in planes)
    told += "; the page has evenly chosen slices of them" if left_out else ""
    note = element("p", told + ".", class_="note")
    return _section("slices", "Slices", note, viewer(planes, windows), _disagreement(run, planes))


def _disagreement(run: Run, planes: Sequence[Plane]) -> Markup | None:
    """Where two estimates differ, in the middle slices."""
    values = run.stored.disagreement
    if values is None:
        return None
    high = grey_range(values)[1]
    heading = element("h3", "Disagreement of voxels and splats", id="disagreement")
    shown = stills(stills_of(planes, values, (0.0, high)), "disagreement", high)
    return joined(heading, element("p", _DISAGREEMENT, class_="note"), shown)


def metrics_section(run: Run, views: Sequence[FramePair]) -> Markup | None:
    """Numbers against the truth, and against the measurement where frames were computed."""
    facts: dict[str, object] = dict(run.metrics)
    if run.reference is not None:
        error = run.stored.values.astype(np.float64) - run.reference
        facts["root_mean_square_error_per_mm"] = float(np.sqrt(np.mean(error**2)))
        facts["mean_error_per_mm"] = float(np.mean(error))
    if views:
        facts["residual_of_the_shown_frames"] = float(np.sqrt(np.mean([view.rms**2 for view in views])))
    if not facts:
        return None
    told = f"Against the reference that the scan carries, {run.compared}. " if run.compared else ""
    if "holdout_rms" in facts:
        told += "Holdout: of line integrals that the method did not see, and what their noise makes of it."
    return _section("metrics", "Metrics", told and element("p", told, class_="note"), facts_table(facts))


def convergence_section(run: Run) -> Markup | None:
    charts = convergence_charts(run.record)
    return _section("convergence", "Convergence", _charts(charts)) if charts else None


def tuning_section(run: Run) -> Markup | None:
    """What an option was chosen by."""
    return _section("tuning", "Tuning", _charts([tuning_chart(run.tuned)])) if run.tuned else None


def scan_section(run: Run) -> Markup:
    facts = {k: v for k, v in run.scan_facts.items() if k != "sha256"}
    return _section("scan", "Scan", element("div", facts_table(facts), class_="columns"))


def geometry_section(scan: Scan) -> Markup:
    arc = ", and the arc through which it moves in the first; grey, the panel at the arc's end"
    above = f"From above: where the source stands in the middle of every frame{arc if scan.is_fly else ''}."
    side = "From the side: the cone of the first frame."
    return _section("geometry", "Geometry", _charts([(above, orbit_chart(scan)), (side, side_chart(scan))]))


def shutter_section(run: Run, scan: Scan) -> Markup | None:
    """Times of a frame, and of frames after each other where the gantry moves; None of a scan that stops for exposures of no
    stated length."""
    if not scan.is_fly and scan.shutter.exposure_s == 0:
        return None
    words = shutter_words(scan)
    one = words[0].upper() + words[1:] + "."
    if run.motion is not None:
        one += f" {_motion_words(run.motion)}"
    several = "The first frames on one axis of time."
    charts = [(one, shutter_chart(scan, run.motion))]
    if scan.is_fly:
        charts.append((several, frames_chart(scan)))
    return _section("shutter", "Shutter in space and time", _charts(charts))


def projections_section(scan: Scan, views: Sequence[FramePair]) -> Markup | None:
    """Measured, computed and residual frames; one range of grey values for all, one of residuals."""
    if not views:
        return None
    low = min(0.0, *(float(v.measured.min()) for v in views))
    high = max(float(v.measured.max()) for v in views)
    limit = max(float(np.percentile(np.abs(v.residual), 99.5)) for v in views) or 1.0
    shape, pitch_mm = scan.geometry.detector_shape, scan.geometry.pixel_size_mm
    proportion = shape[1] * pitch_mm[1], shape[0] * pitch_mm[0]
    told = f"Line integrals, black {number(low)}, white {number(high)}; residuals, measured less computed, "
    told += f"blue −{number(limit)}, red +{number(limit)}. "
    if scan.is_fly:
        told += f"Every line is computed from the volume at {TIMES_PER_LINE} times of its own exposure."
    else:
        told += "Every frame is computed from its one pose."
    rows = [_view(view, (low, high), limit, proportion) for view in views]
    return _section("projections", "Projections", element("p", told, class_="note"), *rows)


def preparation_section(run: Run, changes: Sequence[Change]) -> Markup | None:
    """What each step before the method did: a frame, the line integrals of all, and numbers; those of a scan file that was
    written by ``prepare`` in numbers alone."""
    told = [] if run.scan is None else run.scan.provenance.get(PREPARED_KEY)
    earlier = [element("div", element("h3", str(line.get("step"))), facts_table(line)) for line in _tables(told)]
    if not changes and not earlier:
        return None
    words = "The frame and the sinogram (a line per frame) that each step changed most, and the middle slice, in one range "
    words += "of grey values each; difference, after less before."
    note = element("p", words, class_="note") if changes else None
    return _section("preparation", "Preparation", note, *earlier, *(_change(change) for change in changes))


def calibration_section(scan: Scan) -> Markup | None:
    """What `calibrate` found before the scan was reconstructed, the first time first: tables, and what was corrected of
    single views."""
    known = [*_tables(scan.provenance.get("calibrated_before")), *_tables([scan.provenance.get("calibration")])]
    parts = [part for told in known if (lines := _tables(told.get("parameters"))) for part in _calibrated(told, lines, scan)]
    if not parts:
        return None
    words = "What the scan says of itself was found from its frames"
    words += f", {len(known)} times over, each from what was left before." if len(known) > 1 else "."
    return _section("calibration", "Calibration", element("p", words, class_="note"), *parts)


def _calibrated(told: Mapping[str, object], lines: Sequence[Mapping[str, object]], scan: Scan) -> list[Markup]:
    """A table of a line per parameter, what cannot be told apart, and a chart of every number of views."""
    heads = element("tr", *(element("th", name, scope="col") for name in ("parameter", "stated", "found", "verdict")))
    rows = [element("tr", *(element("td", cell) for cell in _found(line))) for line in lines[:_MOST_ROWS]]
    before, after = (_or_dash(told.get(f"residual_rms_{when}")) for when in ("before", "after"))
    notes = [f"Residual of the frames: {before} before, {after} after (RMS)."]
    alike, views = told.get("alike"), told.get("views")
    notes += [f"Cannot be told apart: {shown(words)}." for words in alike[:_MOST_ALIKE]] if isinstance(alike, list) else []
    known = list(views.items())[:_MOST_CHARTS] if isinstance(views, Mapping) else []
    charts = [views_chart(key, values) for key, values in known if isinstance(values, list) and len(values) == scan.frames]
    return [
        element("table", element("thead", heads), element("tbody", *rows)),
        *(element("p", words, class_="note") for words in notes),
        _charts(chart for chart in charts if chart is not None),
    ]


def _found(line: Mapping[str, object]) -> list[str]:
    """The cells of a parameter: found with its deviation, or nothing."""
    name, scale, stated, found, deviation, verdict = (
        line.get(key) for key in ("name", "unit", "stated", "found", "deviation", "verdict")
    )
    of = scale if isinstance(scale, str) else ""
    value = "–" if found is None else f"{shown(found)} ± {_or_dash(deviation, of)}"
    if isinstance(found, float) and isinstance(deviation, float) and abs(found) + deviation < _ABSURD:
        value = f"{to_digits_of(found, deviation)} ± {shown(to_digits_of(deviation, deviation), of)}"
    return [_or_dash(name), _or_dash(stated, of), value, _or_dash(verdict)]


def _or_dash(value: object, unit_name: str = "") -> str:
    return "–" if value is None else shown(value, unit_name)


def _tables(told: object) -> list[Mapping[str, object]]:
    return [line for line in told if isinstance(line, Mapping)] if isinstance(told, list) else []


def _change(change: Change) -> Markup:
    shown = [_compared(change.step, name, *pair) for name, pair in change.pairs.items()]
    chart = _charts([("Line integrals of all frames: dashed before, drawn after.", histogram(change.edges, change.counts))])
    return joined(*shown, chart, facts_table(change.numbers))


def _compared(step: str, name: str, before: np.ndarray, after: np.ndarray) -> Markup:
    """An image before and after a step, and what the step did to it."""
    low, high = float(before.min()), float(before.max())
    difference = after - before
    limit = float(np.percentile(np.abs(difference), 99.9)) or float(np.abs(difference).max()) or 1.0
    pictures = [
        ("before", png_bytes(top_row_first(bytes_of(before, low, high)))),
        ("after", png_bytes(top_row_first(bytes_of(after, low, high)))),
        (f"difference, ±{number(limit)}", png_bytes(top_row_first(bytes_of(difference, -limit, limit)), diverging())),
    ]
    figures = [
        element(
            "figure",
            element("div", element("img", src=data_uri(png), alt=f"{step}, {name}, {words}"), class_="picture"),
            element("figcaption", words),
        )
        for words, png in pictures
    ]
    return element("div", element("h3", f"{step}: {name}"), *figures, class_="view")


def provenance_section(run: Run) -> Markup:
    """Everything that the volume file keeps about its making, but the convergence record."""
    facts = {k: v for k, v in run.stored.provenance.items() if k not in ("record", "options")}
    options = run.stored.provenance.get("options")
    parts: list[object] = [facts_table(facts)]
    if isinstance(options, Mapping):
        told = element("summary", "All options of the method")
        parts.append(element("details", told, facts_table(options)))
    return _section("provenance", "Provenance", *parts)


def facts_table(facts: Mapping[str, object]) -> Markup:
    """A row per fact: name, value with unit."""
    cells = [(label(key), shown(value, unit(key))) for key, value in list(flattened(facts))[:_MOST_ROWS]]
    lines = [element("tr", element("th", name, scope="row"), element("td", value)) for name, value in cells]
    return element("table", element("tbody", *lines))


def _view(view: FramePair, window: tuple[float, float], limit: float, proportion: tuple[float, float]) -> Markup:
    residual = png_bytes(top_row_first(bytes_of(view.residual, -limit, limit)), diverging())
    pictures = [
        ("measured", png_bytes(top_row_first(bytes_of(view.measured, *window)))),
        ("computed", png_bytes(top_row_first(bytes_of(view.computed, *window)))),
        (f"residual, RMS {number(view.rms)} ({number(100 * view.relative)} %)", residual),
    ]
    style = f"aspect-ratio: {proportion[0]:.6g} / {proportion[1]:.6g}"
    figures = []
    for words, png in pictures:
        image = element("img", src=data_uri(png), alt=f"frame {view.frame}, {words}", style=style)
        picture = element("div", image, class_="picture")
        figures.append(element("figure", picture, element("figcaption", words)))
    return element("div", element("h3", f"Frame {view.frame}"), *figures, class_="view")


def _motion_words(motion: Motion) -> str:
    match motion:
        case MicroViews():
            words = f"dots are the poses of {motion.strips} strips × {motion.sub_intervals} sub-intervals"
        case PerRow():
            words = f"dashed lines are the times that all lines share, {motion.sub_intervals} to an exposure"
        case OwnTimes():
            words = f"dots are the {motion.sub_intervals} poses of some of the lines"
        case LineMiddles():
            words = "dots are the poses of some of the lines"
        case Exact():
            words = "dashed lines bound the segments in which Gaussians move"
        case _:
            words = "the dashed line is the one pose of a frame"
    return f"The run's motion is {motion_facts(motion)['name']}: {words}."


def _charts(charts: Iterable[Chart]) -> Markup:
    figures = [element("figure", drawing, element("figcaption", words)) for words, drawing in charts]
    return element("div", *figures, class_="charts")


def _section(identifier: str, heading: str, *content: object) -> Markup:
    title = element("h2", heading, id=f"{identifier}-heading")
    body = joined(*(part for part in content if part))
    return element("section", title, body, id=identifier, aria_labelledby=f"{identifier}-heading")
