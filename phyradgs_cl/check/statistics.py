"""What the residuals of a few hypotheses say, with how sure one can be of it: frames are the sample."""

import numpy as np

_DRAWS = 200
_TINY = 1e-30


def t_statistic(stated: np.ndarray, other: np.ndarray) -> float:
    """By how many standard errors the stated hypothesis explains the frames (F,) better than the other, relative to the
    stated one's residuals frame by frame. 0 with fewer than three frames, or where both are the same."""
    difference = (other - stated) / np.maximum(stated + other, _TINY)
    if difference.size < 3:
        return 0.0
    error = float(difference.std(ddof=1)) / np.sqrt(difference.size)
    return float(difference.mean()) / error if error > 0 else 0.0


def residual_ratio(stated: np.ndarray, other: np.ndarray) -> float:
    """Residual (F,) squared of the other over that of the stated hypothesis, of all frames together."""
    return float(other.sum() / max(float(stated.sum()), _TINY))


def vertex(at: np.ndarray, squares: np.ndarray) -> tuple[float, float]:
    """Where the parabola through sums of squares (3, F) at three even, ascending places (3,) has its minimum, and the
    standard deviation of that, by drawing frames anew (bootstrap); NaN where there is no minimum."""
    frames = squares.shape[1]
    draws = np.random.default_rng(0).integers(0, frames, (_DRAWS, frames))
    found = np.array([_minimum(at, squares[:, draw].sum(1)) for draw in draws])
    known = found[np.isfinite(found)]
    spread = float(known.std(ddof=1)) if known.size > _DRAWS // 2 else float("nan")
    return _minimum(at, squares.sum(1)), spread


def _minimum(at: np.ndarray, sums: np.ndarray) -> float:
    step = at[1] - at[0]
    bend = sums[0] - 2 * sums[1] + sums[2]
    if bend <= 0:
        return float("nan")
    return float(at[1] + step * np.clip((sums[0] - sums[2]) / (2 * bend), -3, 3))
