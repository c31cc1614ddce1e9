"""Adam (Kingma and Ba 2015) on the raw parameters of all Gaussians at once, with a decaying rate per parameter row."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.fields import Activation
from phyradgs_cl.runtime import DeviceArray, Runtime

_RANGE = (1e-12, 10)  # limits of a learning rate: 0 could not decay, and 1e-12 moves nothing in float32


@dataclass(frozen=True)
class Rates:
    """The (first, last) learning rate of each type of parameter, in internal units (half-sides of the volume).

    The default rates are two to ten times the published ones, which are made for 20,000 iterations and more. In 3,000
    iterations, the published rates end 1 to 2 dB lower (docs/results/settings.md)."""

    position: tuple[float, float] = checks.ranged((2e-3, 2e-4), *_RANGE)
    scale: tuple[float, float] = checks.ranged((2e-2, 2e-3), *_RANGE)
    rotation: tuple[float, float] = checks.ranged((1e-2, 1e-3), *_RANGE)
    density: tuple[float, float] = checks.ranged((6e-2, 6e-3), *_RANGE)

    def __post_init__(self) -> None:
        checks.fields_within("rates.", self)

    def at(self, progress: float) -> np.ndarray:
        """Returns the rates (11,) per parameter row, at ``progress`` (0 to 1) of the run."""
        position, scale, rotation, density = (
            first * (last / first) ** progress
            for first, last in (self.position, self.scale, self.rotation, self.density)
        )
        return np.array([position] * 3 + [scale] * 3 + [rotation] * 4 + [density])


PUBLISHED_RATES = Rates(
    position=(2e-4, 2e-5), scale=(5e-3, 5e-4), rotation=(1e-3, 1e-4), density=(1e-2, 1e-3)
)


BETA1, BETA2 = 0.9, 0.999  # Adam's decay rates of the first and second moments
EPSILON = 1e-15  # Adam's addend to the root of the second moments, before the division by it


def folded_rates(rates: np.ndarray, step: int) -> np.ndarray:
    """Returns the learning rates (11,) with both bias corrections of step ``step`` (from 1) folded in.

    m̂/√v̂ = m/√v · √(1−β2^t)/(1−β1^t). ε is scaled along, which has no effect at 1e-15."""
    return np.asarray(rates * np.sqrt(1 - BETA2**step) / (1 - BETA1**step))


def adam_step(
    raw: np.ndarray, gradients: np.ndarray, moments: np.ndarray, rates: np.ndarray, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the raw parameters (11, G) and moments (2, 11, G) after one step: the float64 twin of ``DeviceAdam.step``."""
    first = BETA1 * moments[0] + (1 - BETA1) * gradients
    second = BETA2 * moments[1] + (1 - BETA2) * gradients**2
    stepped = raw - folded_rates(rates, step)[:, None] * first / (np.sqrt(second) + EPSILON)
    return stepped, np.stack([first, second])


class DeviceAdam:
    """Runs Adam's kernels on raw parameters (11, stride) and their moments on the device."""

    def __init__(self, rt: Runtime, activation: Activation) -> None:
        self.rt, self.activation = rt, activation
        self._activate = rt.kernel("adam", "activate")
        self._chain = rt.kernel("adam", "chain_activations")
        self._step = rt.kernel("adam", "adam_step")

    def activate(self, raw: DeviceArray, parameters: DeviceArray, count: int, stride: int) -> None:
        """Writes parameter rows (11, stride) from raw rows; ``count`` of the columns are Gaussians."""
        self.rt.launch(
            self._activate, stride // self.rt.lanes, raw, count, stride,
            np.float32(self.activation.scale_min), np.float32(self.activation.scale_max), parameters,
            group=self.rt.group(),
        )  # fmt: skip

    def chain(
        self, raw: DeviceArray, parameters: DeviceArray, gradients: DeviceArray, statistics: DeviceArray,
        count: int, stride: int, *, density_weight: float,
    ) -> None:
        """Replaces dL/d(parameters) in ``gradients`` by dL/d(raw), adds the term of the mean density, and adds to the
        ``statistics`` of density control."""
        share = 1.0 / max(count, 1)
        self.rt.launch(
            self._chain, stride // self.rt.lanes, raw, parameters, count, stride,
            np.float32(self.activation.scale_min), np.float32(self.activation.scale_max),
            np.float32(density_weight * share), gradients, statistics, group=self.rt.group(),
        )  # fmt: skip

    def step(
        self, raw: DeviceArray, gradients: DeviceArray, moments: DeviceArray, stride: int, rates: np.ndarray,
        step: int,
    ) -> None:
        """Takes one step of Adam down ``gradients``, dL/d(raw). rates (11,): learning rates per parameter row. step:
        counts from 1."""
        rates16 = np.zeros(16, np.float32)
        rates16[:11] = folded_rates(rates, step)
        self.rt.launch(
            self._step, (stride // self.rt.lanes, 11), raw, gradients, moments, stride, rates16,
            np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON), group=self.rt.group(),
        )  # fmt: skip
