"""The first frame of a fly-scan in motion: the data from which the page's script draws it."""

import json
from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import Shutter, make_protocol
from phyradgs_cl.report.motion import frame_in_motion

pytestmark = pytest.mark.slow


def data_of(parse, scan) -> dict:
    page = parse(frame_in_motion(scan))
    assert not page.open and {"rows", "rows-play", "rows-time", "rows-reset"} <= set(page.ids)
    return json.loads(page.texts["script"][0])


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_lines_and_poses_are_those_of_the_scan(scan_maker, parse, axis) -> None:
    """To a fraction of a pixel between two poses too, where the script interpolates linearly."""
    scan = scan_maker(readout_axis=axis, protocol=make_protocol("rapid", views=8, exposure_deg=20.0))
    data = data_of(parse, scan)
    assert data["axis"] == axis and data["lines"] == list(range(scan.lines)) and data["shape"] == [16, 14]
    assert data["times_s"] == [0.0, pytest.approx(scan.shutter.span_s)]
    times_s = scan.frame_start_s[0] + np.linspace(*data["times_s"], len(data["poses"]))
    assert np.array(data["poses"]) == pytest.approx(scan.trajectory.pose(0, times_s), abs=1e-5)
    angles_deg = np.rad2deg(scan.trajectory.angle_rad(0, times_s))
    assert np.array(data["angles_deg"])[:, 0] == pytest.approx(angles_deg) and np.ptp(angles_deg) > 20
    opens_s, closes_s = np.array(data["opens_s"]), np.array(data["closes_s"])
    assert opens_s == pytest.approx(scan.shutter.delay_s(scan.lines))
    assert closes_s - opens_s == pytest.approx(np.full(scan.lines, scan.shutter.exposure_s))
    poses, times_s = np.array(data["poses"]), np.linspace(*times_s[[0, -1]], 2 * len(times_s) - 1)[1::2]
    error_mm = np.abs((poses[1:] + poses[:-1]) / 2 - scan.trajectory.pose(0, times_s))[:, :6].max()
    assert error_mm < 0.01 * min(scan.geometry.pixel_size_mm)


def test_a_pulse_lights_a_part_of_the_window(scan_maker, parse) -> None:
    scan = scan_maker()
    pulsed = Shutter(scan.shutter.exposure_s, scan.shutter.readout_s, pulse_s=(0.5 * scan.shutter.exposure_s, 0.1))
    data = data_of(parse, replace(scan, shutter=pulsed))
    assert data["times_s"] == pytest.approx([0.5 * scan.shutter.exposure_s, 0.5 * scan.shutter.exposure_s + 0.1])
    assert min(data["opens_s"]) >= data["times_s"][0] - 1e-9 and max(data["closes_s"]) <= data["times_s"][1] + 1e-9
