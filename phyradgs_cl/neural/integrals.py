"""Line integrals of a field by samples along rays, and what a pixel measures over its exposure."""

import math
from collections.abc import Callable

import numpy as np
import torch

Field = Callable[[torch.Tensor], torch.Tensor]


def box_span(
    source: torch.Tensor, direction: torch.Tensor, half_sides: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """(first distance, length) (R,) of rays (R, 3) in a box of ``half_sides`` (3,) about 0; length 0 where they miss it.

    Directions have unit length; a ray begins at its source."""
    tiny = torch.finfo(direction.dtype).tiny
    slope = torch.where(direction.abs() < tiny, torch.full_like(direction, tiny), direction)
    one, other = (-half_sides - source) / slope, (half_sides - source) / slope
    first = torch.minimum(one, other).amax(-1).clamp(min=0)
    last = torch.maximum(one, other).amin(-1)
    return first, (last - first).clamp(min=0)


def sample_shifts(rays: int, samples: int, jitter: str, rng: np.random.Generator) -> np.ndarray:
    """Where in its interval each sample lies, 0 to 1; (R, 1) for one shift per ray or none, (R, samples) for one each."""
    if jitter == "none":
        return np.full((rays, 1), 0.5, np.float32)
    return rng.random((rays, samples if jitter == "sample" else 1), np.float32)


def line_integrals(
    field: Field, source: torch.Tensor, direction: torch.Tensor, half_sides: torch.Tensor, samples: int,
    shifts: torch.Tensor,
) -> torch.Tensor:
    """Integrals (R,) of a field along rays (R, 3), a sample in each of ``samples`` equal intervals inside the box.

    ``shifts`` as from ``sample_shifts``. With shifts drawn uniformly the mean is the integral itself, for any field."""
    first, length = box_span(source, direction, half_sides)
    step = length / samples
    number = torch.arange(samples, dtype=source.dtype, device=source.device)
    distance = first[:, None] + (number + shifts) * step[:, None]
    positions = source[:, None] + distance[..., None] * direction[:, None]
    values = field(positions.reshape(-1, 3)).reshape(len(source), samples)
    return values.sum(1) * step


def intensity_average(integrals: torch.Tensor, unit: float) -> torch.Tensor:
    """−ln(mean over K of exp(−unit · p)) / unit (R,) of the integrals p (R, K) at a pixel's times."""
    return (math.log(integrals.shape[1]) - torch.logsumexp(-unit * integrals, 1)) / unit


def log_squares(integrals: torch.Tensor, measured: torch.Tensor, times: int) -> torch.Tensor:
    """Squared errors (R,) of the mean over all ``times`` of a pixel, estimated from s of them, integrals (R, s).

    The square of a mean over a random subset is too large by the subset's variance, which (1/s − 1/K) times the spread
    among the s samples estimates; less that, expectation and gradient are those of all K times."""
    count = integrals.shape[1]
    squares = (integrals.mean(1) - measured) ** 2
    if count == times:
        return squares
    return squares - (1 / count - 1 / times) * integrals.var(1, unbiased=True)
