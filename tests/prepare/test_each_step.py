"""Each step on 180 views of 32² pixels, 60 if it reconstructs: a clean scan is left alone, a planted fault removed."""

from dataclasses import replace

import numpy as np
import pytest

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api import prepare
from phyradgs_cl.detector import tube_spectrum
from phyradgs_cl.detector.effects import add_scatter, beer_lambert_noise, drifting_light
from phyradgs_cl.prepare import PREPARED_KEY, find_dead, water_polynomial


@pytest.fixture(scope="module")
def clean(closed_form) -> Scan:
    return closed_form("skull", panel=32, dose=1e5, noise=beer_lambert_noise)


@pytest.fixture(scope="module")
def few(closed_form) -> Scan:
    return closed_form("skull", panel=32, dose=1e5, noise=beer_lambert_noise, views=60)


def with_frames(scan: Scan, frames: np.ndarray) -> Scan:
    return replace(scan, projections=frames.astype(np.float32))


def rms(frames: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(frames, dtype=np.float64))))


def test_sparks(rt, clean) -> None:
    assert prepare(clean, "sparks", device=rt).projections is clean.projections
    frames = clean.projections.copy()
    places = [(f, 5 + f % 20, 8 + f % 15) for f in range(0, 180, 9)]
    for place in places:
        frames[place] -= 1.5
    prepared = prepare(with_frames(clean, frames), "sparks", device=rt)
    masked = set(map(tuple, np.argwhere(~prepared.valid).tolist()))
    assert masked <= set(places) and len(masked) >= 0.9 * len(places)
    assert rms(prepared.projections - clean.projections) < 0.3 * rms(frames - clean.projections)


def test_dead_pixels(rt, clean) -> None:
    assert prepare(clean, "dead", device=rt).projections is clean.projections
    frames = clean.projections.copy()
    frames[:, 9, 20], frames[:, 14, 6], frames[:, 25], frames[:, :, 11] = 0.4, 5.0, 6.0, -0.3
    prepared = prepare(with_frames(clean, frames), "dead", device=rt)
    bad, facts = ~prepared.valid.all(axis=0), prepared.provenance[PREPARED_KEY][0]
    assert bad[9, 20] and bad[14, 6] and bad[25].all() and bad[:, 11].all() and bad.sum() == 32 + 31 + 2
    assert (facts["step"], facts["rows"], facts["columns"]) == ("dead", 1, 1) and not find_dead(frames[:4]).any()
    assert rms(prepared.projections - clean.projections) < 0.1 * rms(frames - clean.projections)


@pytest.mark.slow
def test_scatter(rt, few) -> None:
    """Of a clean scan the fit takes less than the noise of a pixel; of scatter most goes."""
    unchanged = prepare(few, "scatter", device=rt).projections
    noise = rms(np.diff(few.projections[:, :3, :3], axis=0)) / np.sqrt(2)
    assert rms(unchanged - few.projections) < noise
    scattered = with_frames(few, add_scatter(few.projections, 0.2))
    prepared = prepare(scattered, "scatter", device=rt)
    error = rms(scattered.projections - few.projections)
    assert error > 3 * noise and rms(prepared.projections - few.projections) < 0.5 * error
    stated = prepare(scattered, "scatter", scatter={"to_primary": 0.2}, device=rt)
    assert rms(stated.projections - few.projections) < 0.35 * error


def test_air(rt, clean) -> None:
    """Each frame's median of air goes to 0: for a clean scan by a fraction of a pixel's noise."""
    noise = rms(np.diff(clean.projections[:, :3, :3], axis=0)) / np.sqrt(2)
    unchanged = prepare(clean, "air", device=rt).projections
    assert rms(unchanged - clean.projections) < 0.3 * noise
    light = drifting_light(180, 0.05, np.random.default_rng(1))
    drifting = with_frames(clean, clean.projections - np.log(light)[:, None, None])
    prepared = prepare(drifting, "air", device=rt)
    assert rms(prepared.projections - clean.projections) < 0.1 * rms(drifting.projections - clean.projections)
    assert prepared.provenance[PREPARED_KEY][0]["light"] == pytest.approx([light.min(), light.max()], rel=0.003)


@pytest.mark.slow
def test_hardening(rt, few) -> None:
    """No correction explains a straight scan better than none; a wedge's polynomial straightens water."""
    assert prepare(few, "hardening", hardening={"kvp": 100.0}, device=rt).projections is few.projections
    bent = with_frames(few, tube_spectrum(100.0).hardened(few.projections))
    wedge = {"polynomial": water_polynomial(100.0)}
    prepared = prepare(bent, "hardening", hardening=wedge, device=rt)
    error = rms(bent.projections - few.projections)
    assert rms(prepared.projections - few.projections) < 0.05 * error


@pytest.mark.parametrize("gain", [1.01, 1.03])
def test_rings(rt, clean, gain) -> None:
    """A single column of a wrong gain is regained, and nothing else changes."""
    assert prepare(clean, "rings", device=rt).projections is clean.projections
    frames = clean.projections.copy()
    frames[:, :, 8] -= np.float32(np.log(gain))
    prepared = prepare(with_frames(clean, frames), "rings", device=rt)
    change = (prepared.projections - clean.projections).mean(axis=0)
    assert np.abs(change[:, 8]).mean() < 0.25 * np.log(gain) and not np.delete(change, 8, axis=1).any()
