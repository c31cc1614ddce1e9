"""Objects that move in an unknown way: the signal of their motion, their field, their volume."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ConstantSpeed, Scan, Shutter
from phyradgs_cl.fields import Grid
from phyradgs_cl.reconstructors.moving.signal import motion_signal

FRAMES, PERIOD_S, STEP_S = 90, 3.1, 0.5


def shroud_scan(height_of, noise: float = 0.05) -> Scan:
    """Frames of a horizontal edge at a height in rows, (F,) of the times (F,) in s, whose width changes with the angle."""
    geometry = ConeGeometry(5.0, 7.0, (24, 20), (0.2, 0.2))
    start_s = STEP_S * np.arange(FRAMES)
    turn_rad = 2 * np.pi / (FRAMES * STEP_S)
    rows = np.arange(24)
    edge = 1 / (1 + np.exp((rows - 12 - height_of(start_s + 0.2)[:, None]) / 1.5))
    width = 1 + 0.3 * np.cos(2 * turn_rad * start_s) + 0.1 * np.sin(3 * turn_rad * start_s)
    frames = (edge * width[:, None])[:, :, None] + np.random.default_rng(0).normal(0, noise, (FRAMES, 24, 20))
    orbit = CircularOrbit(geometry, ConstantSpeed(0.0, turn_rad))
    return Scan(frames.astype(np.float32), geometry, orbit, Shutter(0.4), start_s, Grid.cube(8, 2.0))


def test_the_signal_has_the_period_and_the_curve_of_the_motion() -> None:
    def phase(t):  # of breaths that differ in length
        return 2 * np.pi * t / PERIOD_S + 0.3 * np.sin(0.2 * t)

    scan = shroud_scan(lambda t: 2 * np.cos(phase(t)))
    signal = motion_signal(scan)
    assert signal.period_s == pytest.approx(PERIOD_S, rel=0.03)
    curve = np.cos(phase(signal.times_s))
    assert abs(np.corrcoef(signal.values, curve)[0, 1]) > 0.95
    assert np.abs(signal.values).max() == pytest.approx(1)
    quadrature = signal.pair()[:, 1]
    assert abs(np.corrcoef(quadrature, np.sin(phase(signal.times_s)))[0, 1]) > 0.9


@pytest.mark.parametrize("height_of", [np.zeros_like, lambda t: 3 * np.exp(-t / 15.0)], ids=["rest", "settling"])
def test_what_does_not_repeat_has_no_period(height_of) -> None:
    assert motion_signal(shroud_scan(height_of)).period_s is None


def test_masked_pixels_do_not_matter() -> None:
    scan = shroud_scan(lambda t: 2 * np.cos(2 * np.pi * t / PERIOD_S))
    frames = scan.projections.copy()
    frames[:, 3, 5] = 1e6
    mask = np.zeros((24, 20), np.uint8)
    mask[3, 5] = 1
    masked = replace(scan, projections=frames, pixel_mask=mask)
    assert motion_signal(masked).period_s == pytest.approx(PERIOD_S, rel=0.03)
