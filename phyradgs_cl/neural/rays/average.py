"""What a pixel measures over its exposure, and the squared error of a prediction from a few of its times."""

import math

import torch


def intensity_average(integrals: torch.Tensor, unit: float) -> torch.Tensor:
    """−ln(mean over K of exp(−unit · p)) / unit (R,) of the integrals p (R, K) at a pixel's times."""
    return (math.log(integrals.shape[1]) - torch.logsumexp(-unit * integrals, 1)) / unit


def log_squares(integrals: torch.Tensor, measured: torch.Tensor, times: int) -> torch.Tensor:
    """Squared errors (R,) of the mean over all ``times`` of a pixel, estimated from s of them, integrals (R, s).

    The square of a mean over a random subset is too large by the subset's variance, which (1/s − 1/K) times the spread
    among the s samples estimates; less that, expectation and gradient are those of all K times.
    """
    count = integrals.shape[1]
    squares = (integrals.mean(1) - measured) ** 2
    if count == times:
        return squares
    return squares - (1 / count - 1 / times) * integrals.var(1, unbiased=True)
