"""Charts of geometry, shutter and curves, for every kind of scan."""

import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from parallel_kit import SIDE, laminography_scan, parallel_scan

from phyradgs_cl.acquisition import MicroViews, PoseTable, Scan, Shutter, make_protocol
from phyradgs_cl.acquisition.altered.angles import middle_poses
from phyradgs_cl.acquisition.motion import MODELS
from phyradgs_cl.report import charts, scan_charts

pytestmark = pytest.mark.slow


def outlines(scan: Scan) -> list[np.ndarray]:
    """The areas in the drawing of a shutter."""
    scan_charts.draw_shutter(axes := Figure().add_subplot(), scan, None)
    return [patch.get_xy() for patch in axes.patches if isinstance(patch, Polygon)]


@pytest.fixture(scope="module")
def kinds(scan_maker, small_scan) -> dict[str, object]:
    """Scans of every kind that changes a drawing."""
    times_s = np.linspace(0, 30, 40)
    table = PoseTable(times_s, small_scan.trajectory.pose(0, times_s))
    pulsed = make_protocol("rapid", views=8, exposure_deg=20.0, pulse=(0.86, 0.14))
    return {
        "fly": small_scan, "still": scan_maker(protocol=make_protocol("static", views=8)),
        "columns backwards": scan_maker(readout_axis="columns", readout_direction=-1),
        "pulsed": scan_maker(protocol=pulsed), "wobbling": replace(small_scan, trajectory=table),
        "instant": replace(small_scan, shutter=Shutter(0.0)),
        "one frame": replace(small_scan, projections=small_scan.projections[:1], frame_start_s=np.zeros(1)),
    }  # fmt: skip


def test_every_kind_of_scan_is_drawn_with_finite_numbers(kinds) -> None:
    for name, scan in kinds.items():
        drawings = [scan_charts.frames_chart(scan), scan_charts.orbit_chart(scan), scan_charts.side_chart(scan)]
        models = MODELS if name == "fly" else [MicroViews]
        for drawing in (*drawings, *(scan_charts.shutter_chart(scan, model()) for model in models)):
            assert drawing.startswith("<svg") and "nan" not in drawing and "inf" not in drawing, name


def test_a_chart_is_of_its_page(small_scan) -> None:
    """A chart has a label, loads nothing, uses the page's colours, and shares no id with another chart."""
    first, second = scan_charts.orbit_chart(small_scan), scan_charts.side_chart(small_scan)
    assert 'aria-label="Geometry from above. 8 source positions' in first and 'role="img"' in first
    for svg in (first, second):
        assert not re.search(r"http|<style|url\(|#[0-9a-f]{6}\b", svg)
        names, uses = re.findall(r' id="(\w+)"', svg), re.findall(r'href="#(\w+)"', svg)
        assert set(uses) == set(names) and len(names) == len(set(names))
    assert not set(re.findall(r' id="(\w+)"', first)) & set(re.findall(r' id="(\w+)"', second))
    hostile = charts.chart(lambda axes: axes.set_xlabel("</svg><script>$\\frac$"), "<b>", '"')
    assert "<script" not in hostile and "$\\frac$" in hostile and "<b>" not in hostile


def test_the_window_of_a_frame_is_a_parallelogram_from_opening_to_closing(kinds, small_scan) -> None:
    (outline,) = outlines(small_scan)
    lowest, highest = outline[outline[:, 1] == 0], outline[outline[:, 1] == outline[:, 1].max()]
    shutter = small_scan.shutter
    assert np.ptp(lowest[:, 0]) == pytest.approx(shutter.exposure_s) == pytest.approx(np.ptp(highest[:, 0]))
    assert highest[:, 0].max() - lowest[:, 0].min() == pytest.approx(shutter.span_s)
    opened, lit = outlines(kinds["pulsed"])
    assert np.ptp(lit[:, 0]) < 0.2 * np.ptp(opened[:, 0])


def test_the_orbit_is_that_of_the_scan_and_the_panel_ends_half_a_pixel_beyond_its_pixels(small_scan) -> None:
    positions = scan_charts.with_sources(small_scan, middle_poses(small_scan))[:, :3]
    assert np.allclose(np.linalg.norm(positions, axis=1), 5.0) and len(positions) == 8
    corners = scan_charts.panel_corners(small_scan.geometry.pose(0.0), small_scan.geometry.detector_shape)
    assert np.allclose(corners.mean(axis=0), [-2, 0, 0])
    assert np.allclose(np.ptp(corners, axis=0), [0, 14 * 0.25, 16 * 0.25])


def test_parallel_rays_come_from_their_direction_and_have_no_source() -> None:
    for scan in (parallel_scan(12, shutter=Shutter(0.1, 0.5)), laminography_scan(12)):
        drawings = scan_charts.orbit_chart(scan) + scan_charts.side_chart(scan)
        assert "nan" not in drawings and "source" not in drawings and "12 directions of parallel rays" in drawings
        pose, drawn_pose = (poses[3] for poses in (middle_poses(scan), scan_charts.with_sources(scan, middle_poses(scan))))
        middle, reach_mm = scan_charts.panel_corners(drawn_pose, (SIDE, SIDE)).mean(0), np.linalg.norm(scan.grid.size_mm) / 2
        assert np.allclose(np.cross(middle - drawn_pose[:3], pose[:3]), 0)  # the middle ray
        assert drawn_pose[:3] @ pose[:3] < -reach_mm < reach_mm < middle @ pose[:3]  # the volume between both
    first_deg = np.rad2deg(0.3) + 30
    title = parallel_scan(12, shutter=Shutter(0.0, 0.5)).plot(2).axes[1].get_title()
    assert title == f"gantry from {first_deg:.1f}° to {first_deg + 7.5:.1f}°"
