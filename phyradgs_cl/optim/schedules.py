"""Learning rates that decay exponentially from a first to a last value over the run."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks

# A rate of 0 has no decay; 1e-12 moves nothing in float32.
_RANGES = {name: (1e-12, 10) for name in ("position", "scale", "rotation", "density")}


@dataclass(frozen=True)
class Rates:
    """(first, last) rate of each kind of parameter, in internal units (half-sides of the volume).

    The default rates are two to ten times the published ones, which are made for 20,000 iterations and more: at
    3,000 they leave 1 to 2 dB on the table (docs/results/settings.md).
    """

    position: tuple[float, float] = (2e-3, 2e-4)
    scale: tuple[float, float] = (2e-2, 2e-3)
    rotation: tuple[float, float] = (1e-2, 1e-3)
    density: tuple[float, float] = (6e-2, 6e-3)

    def __post_init__(self) -> None:
        checks.fields_within("rates.", self, _RANGES)

    def at(self, progress: float) -> np.ndarray:
        """Rates (11,) per parameter row at ``progress`` (0 to 1) through the run."""
        position, scale, rotation, density = (
            first * (last / first) ** progress
            for first, last in (self.position, self.scale, self.rotation, self.density)
        )
        return np.array([position] * 3 + [scale] * 3 + [rotation] * 4 + [density])


PUBLISHED_RATES = Rates(
    position=(2e-4, 2e-5), scale=(5e-3, 5e-4), rotation=(1e-3, 1e-4), density=(1e-2, 1e-3)
)
