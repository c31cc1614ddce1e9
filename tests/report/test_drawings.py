"""Geometry, shutter and curves: drawn where they are, for every kind of scan."""

import re
from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import MicroViews, PoseTable, Shutter, make_protocol
from phyradgs_cl.acquisition.motion import MODELS
from phyradgs_cl.report.charts.axes import Axes, decades, ticks
from phyradgs_cl.report.charts.curve import convergence_charts, tuning_chart
from phyradgs_cl.report.charts.geometry import orbit_drawing, panel_corners, side_drawing
from phyradgs_cl.report.charts.shutter import frames_drawing, shutter_drawing


def shapes(svg: str, tag: str, class_: str) -> list[np.ndarray]:
    """Points (N, 2) of the polylines or polygons of a class."""
    found = re.findall(rf'<{tag} points="([^"]*)" class="{class_}"', svg)
    return [np.array([[float(v) for v in p.split(",")] for p in points.split()]) for points in found]


def dots(svg: str, class_: str) -> np.ndarray:
    """Centres (N, 2) of the circles of a class."""
    found = re.findall(rf'<circle cx="([\d.-]+)" cy="([\d.-]+)" r="[\d.]+" class="{class_}"', svg)
    return np.array(found, float).reshape(-1, 2)


@pytest.fixture(scope="module")
def kinds(scan_maker, small_scan) -> dict[str, object]:
    """Scans of every kind that changes a drawing."""
    times_s = np.linspace(0, 30, 40)
    table = PoseTable(times_s, small_scan.trajectory.pose(0, times_s))
    pulsed = make_protocol("rapid", views=8, exposure_deg=20.0, pulse=(0.86, 0.14))
    return {
        "fly": small_scan,
        "still": scan_maker(protocol=make_protocol("static", views=8)),
        "columns backwards": scan_maker(readout_axis="columns", readout_direction=-1),
        "pulsed": scan_maker(protocol=pulsed),
        "wobbling": replace(small_scan, trajectory=table),
        "instant": replace(small_scan, shutter=Shutter(0.0)),
        "one frame": replace(small_scan, projections=small_scan.projections[:1], frame_start_s=np.zeros(1)),
    }


def test_every_kind_of_scan_is_drawn_with_finite_numbers(kinds) -> None:
    for name, scan in kinds.items():
        drawings = [frames_drawing(scan), orbit_drawing(scan), side_drawing(scan)]
        for drawing in (*drawings, *(shutter_drawing(scan, model()) for model in MODELS)):
            assert "nan" not in drawing and "inf" not in drawing, name


def test_the_window_of_a_frame_is_a_parallelogram_from_opening_to_closing(kinds, small_scan) -> None:
    (outline,) = shapes(shutter_drawing(small_scan, None), "polygon", "lit")
    lowest, highest = outline[np.isclose(outline[:, 1], outline[:, 1].max())], outline[outline[:, 1].argmin()]
    span = np.ptp(outline[:, 0])
    assert np.ptp(lowest[:, 0]) / span == pytest.approx(1 / 1.86, abs=0.01)
    assert highest[0] > lowest[:, 0].min()  # later lines open later
    svg = shutter_drawing(kinds["pulsed"], None)
    (lit,), (opened,) = shapes(svg, "polygon", "lit"), shapes(svg, "polygon", "open")
    assert np.ptp(lit[:, 0]) < 0.2 * np.ptp(opened[:, 0])


def test_samples_lie_at_the_times_of_the_cells(small_scan) -> None:
    motion = MicroViews(strips=4, sub_intervals=3)
    svg = shutter_drawing(small_scan, motion)
    drawn, (outline,) = dots(svg, "sample"), shapes(svg, "polygon", "lit")
    cells = motion.cells(small_scan, 0)
    share = (drawn[:, 0] - outline[:, 0].min()) / np.ptp(outline[:, 0])
    expected = (cells.time_s - small_scan.frame_start_s[0]) / small_scan.shutter.span_s
    assert len(drawn) == 12 and np.allclose(share, expected, atol=0.01)


def test_the_orbit_is_to_scale(small_scan) -> None:
    svg = orbit_drawing(small_scan)
    frames, (box,) = dots(svg, "frame"), shapes(svg, "polygon", "volume")
    centre = box.mean(axis=0)
    radii = np.linalg.norm(frames - centre, axis=1)
    assert np.allclose(radii / np.ptp(box[:, 0]), 5.0 / 2.0, rtol=0.01)
    first = dots(svg, "source")[0] - centre  # at angle 0 the source lies to the right
    assert first[0] > 0 and abs(first[1]) < 1


def test_the_panel_ends_half_a_pixel_beyond_its_outer_pixels(small_scan) -> None:
    pose = small_scan.geometry.pose(0.0)
    corners = panel_corners(pose, small_scan.geometry.detector_shape)
    assert np.allclose(corners.mean(axis=0), [-2, 0, 0])
    assert np.allclose(np.ptp(corners, axis=0), [0, 14 * 0.25, 16 * 0.25])


def test_a_record_becomes_a_chart_for_each_quantity_that_changes() -> None:
    record = [{"iteration": k, "loss": 1.0 / k, "gaussians": 5.0, "seconds": k} for k in range(1, 2001)]
    (chart,) = convergence_charts(record)
    assert chart[0] == "Loss: from 1 to 0.0005 at iteration 2000."
    (curve,) = shapes(chart[1], "polyline", "curve")
    assert len(curve) < 700 and np.all(np.diff(curve[:, 0]) >= 0)
    assert not convergence_charts([]) and not convergence_charts([{"loss": 1.0}])


def test_what_was_tuned_is_drawn_with_the_choice_on_the_curve() -> None:
    found = {"option": "tv_weight", "chosen": 0.002, "values": [0.001, 0.004, 0.016], "holdout_rms": [3.0, 2.0, 4.0]}
    caption, drawing = tuning_chart(found)
    assert "tv_weight: 0.002" in caption and "nan" not in drawing
    (curve,), marks = shapes(drawing, "polyline", "curve"), dots(drawing, "mark")
    assert curve[1, 0] == pytest.approx(curve[[0, 2], 0].mean(), abs=0.1)  # values by their ratio
    assert np.allclose(marks[-1], curve[:2].mean(axis=0), atol=0.1) and len(marks) == 4
    by_number = tuning_chart({**found, "chosen": 0.004, "values": [0.0, 0.004, 0.016]})[1]
    assert "nan" not in by_number and shapes(by_number, "polyline", "curve")[0][1, 0] < curve[1, 0]


def test_ticks_are_round_and_inside() -> None:
    assert list(ticks(0, 1)) == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert list(ticks(3, 3)) == [3]
    assert list(decades(0.02, 3)) == pytest.approx([0.02, 0.05, 0.1, 0.2, 0.5, 1, 2])
    heights = [Axes((0, 1), (1, 100), log=True).at(0, y)[1] for y in (1, 10, 100)]
    assert heights[1] == pytest.approx((heights[0] + heights[2]) / 2)
