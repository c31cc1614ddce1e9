"""A data sheet's words: the first line, frames per second, readout in ms; and numbers that no scanner has."""

import logging
import re
from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import make_protocol
from phyradgs_cl.acquisition.readout import FIRST_LINES
from phyradgs_cl.api import ConeGeometry, fly_scan, simulate, static_scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.simulation import scanner_for, scanner_options

CONE = ConeGeometry(500.0, 800.0, (6, 8), (0.4, 0.4))
FRAMES, TURN_DEG = np.full((12, 6, 8), 0.5, np.float32), 30.0 * np.arange(12)
SHEET = {"exposure_deg": 27.0, "exposure_s": 0.06}  # 15 frames per second
RIGHT = SHEET | {"readout_ratio": 62 / 60}


def test_the_first_line_states_axis_and_direction() -> None:
    """Seen from the source: row 0 is the lowest, column 0 the left one; the first line opens without a delay."""
    for first, line in {"bottom": 0, "top": 5, "left": 0, "right": 7}.items():
        axis, direction = FIRST_LINES[first]
        order = {"readout": axis, "readout_direction": direction}
        shutter = fly_scan(FRAMES, CONE, TURN_DEG, exposure_deg=30.0, readout_ratio=0.9, **order).shutter
        assert (shutter.axis, shutter.direction) == FIRST_LINES[first] and shutter.first == first
        assert shutter.delay_s(shutter.lines(CONE.detector_shape))[line] == 0


def test_arc_and_time_of_an_exposure_state_the_times_of_a_fly_scan() -> None:
    scan = fly_scan(FRAMES, CONE, TURN_DEG, **RIGHT, readout_direction=-1)
    assert np.allclose(np.diff(scan.frame_start_s), 1 / 15) and scan.shutter.readout_s == pytest.approx(0.062)
    ends = [scan.trajectory.angle_rad(3, scan.frame_start_s[3] + t) for t in (0.0, 0.06)]
    assert np.rad2deg(np.diff(ends)) == pytest.approx(27.0)
    words = "timing: rows read in 62 ms, top first; 15 fps; exposure 27° in 60 ms; averages line integrals"
    assert scan.summary().splitlines()[0] == words


def test_a_simulation_takes_a_data_sheet() -> None:
    scanner = scanner_for("r2", 16)
    options = scanner_options(scanner, "rapid", first="left", fps=15, readout_ms=62)
    shutter = options.protocol.shutter(options.readout_axis, options.readout_direction)
    assert (shutter.exposure_s, shutter.readout_s) == pytest.approx((1 / 15, 0.062)) and shutter.first == "left"
    assert np.allclose(np.diff(options.protocol.frame_start_s()), 1 / 15)
    assert options.protocol.angle_start_rad()[1] == make_protocol("rapid").angle_start_rad()[1]


def test_numbers_that_hardly_a_scanner_has_are_warned_of(caplog) -> None:
    high, tall = np.full((12, 120, 8), 0.5, np.float32), replace(CONE, detector_shape=(120, 8))
    for words, make, args, more in (
        ("^readout_ratio: readout of 0.1 s, 1.5 times", fly_scan, (FRAMES, CONE), SHEET | {"readout_ratio": 100 / 60}),
        ("^readout_ratio: readout of 0.06 ms for 120 .*unit", fly_scan, (high, tall), SHEET | {"readout_ratio": 1e-3}),
        ("^exposure_s: 1.5 fps and 30° from frame to frame", fly_scan, (FRAMES, CONE), RIGHT | {"exposure_deg": 2.7}),
        ("", fly_scan, (FRAMES, CONE), RIGHT),
    ):
        caplog.clear()
        make(*args, TURN_DEG, **more)
        said = [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]
        assert len(said) == bool(words) and re.search(words, "".join(said)), (words, said)


def test_masked_pixels_do_not_hide_opaque_ones(caplog) -> None:
    """Two in a hundred of the pixels that count, but only two in a thousand of all."""
    frames, mask = np.full((12, 10, 50), 0.5, np.float32), np.ones((10, 50), np.uint8)
    mask[:, :5], frames[:, 0, 0] = 0, 60.0
    geometry = replace(CONE, detector_shape=(10, 50))
    static_scan(frames, geometry, TURN_DEG, quantity="attenuation", mask=mask)
    assert re.search("line integrals of up to 60: .* counts", caplog.text)
    with pytest.raises(InputError, match="frames: found values of up to 60"):
        static_scan(frames, geometry, TURN_DEG, mask=mask)


def test_a_summary_shows_what_a_wrong_length_changes(rt) -> None:
    scan = simulate("spheres", size=8, detector=16, views=6, exposure_deg=60.0, device=rt)
    timing, sizes, blur = scan.summary().splitlines()
    assert timing == "timing: rows read in 860 ms, bottom first; 1 fps; exposure 60° in 1000 ms; averages line integrals"
    numbers, largest = [float(n) for n in re.findall(r"[\d.]+", sizes)], float(scan.projections.max())
    assert numbers == pytest.approx([3.642, 2.747, 2.747, 31.9, 31.9, 0.25, largest], rel=1e-3)
    assert blur == "blur at the rim: 8.4 px, at half radius 4.2 px"  # π/3 · 8 columns
    still = static_scan(FRAMES, CONE, TURN_DEG).summary().splitlines()
    assert len(still) == 2 and still[0] == "timing: every frame at rest" and still[1].startswith("sizes: ")
