"""Which raw counts are clipped, and which only look so: air without noise lies together at one count too."""

from itertools import product

import numpy as np

from phyradgs_cl.detector import find_saturation

AIR, SHAPE = 50_000.0, (4, 48, 64)


def counts(noisy: bool, seed: int = 0) -> np.ndarray:
    """Counts (4, 48, 64) of a ball that moves, with air around it, rounded."""
    v, u = np.mgrid[:48, :64]
    chords = [2 * np.sqrt(np.clip(400 - (v - 23.5) ** 2 - (u - c) ** 2, 0, None)) for c in (25, 30, 35, 40)]
    expected = AIR * np.exp(-0.05 * np.stack(chords))
    return np.round(np.random.default_rng(seed).normal(expected, np.sqrt(expected))) if noisy else np.round(expected)


def test_a_panel_that_clips_is_found() -> None:
    for level, flat_too, dtype in product(
        (40_000, 50_100), (False, True), (np.uint16, np.float32, np.float64)
    ):
        frames = np.minimum(counts(noisy=True) + 400, level).astype(dtype)
        found = find_saturation(frames, np.full(SHAPE[1:], min(AIR + 400, level) if flat_too else AIR + 400))
        assert found.level == level and found.share == np.mean(frames == level) > 0.3


GOOD = {
    "noise": (counts(noisy=True), AIR), "no noise": (counts(noisy=False), AIR),
    "no noise at the end of 16 bits": (np.round(counts(noisy=False) * 65535 / AIR), 65535.0),
    "noise and a hot pixel": (np.where(np.arange(64) == 9, 65535, counts(noisy=True)) * (np.arange(48) == 9)[:, None], AIR),
    "NaN": (np.where(counts(True) > 50_500, np.nan, counts(True)), AIR),
}


def test_what_is_not_clipped_is_not_found_and_what_is_all_clipped_is(recwarn) -> None:
    for name, (frames, flat) in GOOD.items():
        found = find_saturation(frames, np.full(SHAPE[1:], flat))
        assert found.share == 0 and found.level == np.nanmax(frames), name
    for frames, share in ((np.full(SHAPE, 4095), 1.0), (np.full(SHAPE, np.nan), 0.0)):
        assert find_saturation(frames, np.full(SHAPE[1:], 4095.0)).share == share
    assert not recwarn
