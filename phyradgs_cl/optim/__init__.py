"""Optimises Gaussians by Adam (Kingma and Ba 2015), with decaying learning rates for each kind of parameter. Density control
clones or splits those Gaussians that the gradient would move most in the image, and removes faint and thin ones.

Density control follows Kerbl et al. 2023 in R2-Gaussian's radiative form. Its statistic is the mean norm of dL/d(projected
centre), with the centre in units of half the detector's size. A clone or split gives two Gaussians of half the density."""

from dataclasses import dataclass

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.fields import Activation
from phyradgs_cl.fields import gaussians as g
from phyradgs_cl.runtime import DeviceArray, Runtime

_RANGE = (1e-12, 10)  # least and largest learning rate: 0 could not decay by a factor; 1e-12 changes no float32 parameter


@dataclass(frozen=True)
class Rates(checks.Checked):
    """The (first, last) learning rate of each kind of parameter, in internal units (half the volume's longest side).

    The default rates are four to ten times the published ones, which are made for 20,000 iterations and more. After 3,000
    iterations at the published rates, the PSNR is 1 to 2 dB lower (docs/results/settings.md)."""

    PREFIX = "rates."

    position: tuple[float, float] = checks.ranged((2e-3, 2e-4), *_RANGE)
    scale: tuple[float, float] = checks.ranged((2e-2, 2e-3), *_RANGE)
    rotation: tuple[float, float] = checks.ranged((1e-2, 1e-3), *_RANGE)
    density: tuple[float, float] = checks.ranged((6e-2, 6e-3), *_RANGE)

    def at(self, progress: float) -> np.ndarray:
        """Returns the learning rates (11,) of a Gaussian's parameters at the fraction ``progress``, 0 to 1, of the run."""
        position, scale, rotation, density = (
            first * (last / first) ** progress
            for first, last in (self.position, self.scale, self.rotation, self.density)
        )
        return np.array([position] * 3 + [scale] * 3 + [rotation] * 4 + [density])


PUBLISHED_RATES = Rates(
    position=(2e-4, 2e-5), scale=(5e-3, 5e-4), rotation=(1e-3, 1e-4), density=(1e-2, 1e-3)
)


BETA1, BETA2 = 0.9, 0.999  # Adam's decay rates of the first and second moments, as in its paper
EPSILON = 1e-15  # added to the root of the second moment, which may be 0, before Adam divides by it


def folded_rates(rates: np.ndarray, step: int) -> np.ndarray:
    """Returns the learning rates (11,) times the factor √(1−β2^t)/(1−β1^t) of Adam's bias corrections. step: t, from 1 on.

    With the moments m and v, and m̂ and v̂ after bias correction, m̂/√v̂ is m/√v times this factor. The factor thus scales ε
    in Adam's denominator too, which does not matter for an ε of 1e-15."""
    return np.asarray(rates * np.sqrt(1 - BETA2**step) / (1 - BETA1**step))


def adam_step(
    raw: np.ndarray, gradients: np.ndarray, moments: np.ndarray, rates: np.ndarray, step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns raw parameters (11, G) and moments (2, 11, G) after one step down ``gradients`` (11, G): the float64 twin of
    ``DeviceAdam.step``."""
    first = BETA1 * moments[0] + (1 - BETA1) * gradients
    second = BETA2 * moments[1] + (1 - BETA2) * gradients**2
    stepped = raw - folded_rates(rates, step)[:, None] * first / (np.sqrt(second) + EPSILON)
    return stepped, np.stack([first, second])


class DeviceAdam:
    """Runs Adam's kernels on raw (unconstrained) parameters (11, stride) and their moments on the device."""

    def __init__(self, rt: Runtime, activation: Activation) -> None:
        self.rt, self.activation = rt, activation
        self._activate = rt.kernel("adam", "activate")
        self._chain = rt.kernel("adam", "chain_activations")
        self._step = rt.kernel("adam", "adam_step")

    def activate(self, raw: DeviceArray, parameters: DeviceArray, count: int, stride: int) -> None:
        """Computes ``parameters`` (11, stride) from ``raw``. The first ``count`` columns are Gaussians, the rest padding."""
        self.rt.launch(
            self._activate, stride // self.rt.lanes, raw, count, stride,
            np.float32(self.activation.scale_min), np.float32(self.activation.scale_max), parameters,
            group=self.rt.group(),
        )  # fmt: skip

    def chain(
        self, raw: DeviceArray, parameters: DeviceArray, gradients: DeviceArray, statistics: DeviceArray,
        count: int, stride: int, *, density_weight: float,
    ) -> None:
        """Turns dL/d(parameters) in ``gradients`` into dL/d(raw), with L extended by ``density_weight`` times the mean
        density. Adds one frame's gradient norms to density control's ``statistics``."""
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
        """Takes one step of Adam down ``gradients``, dL/d(raw). rates (11,): learning rates. step: counts from 1."""
        rates16 = np.zeros(16, np.float32)
        rates16[:11] = folded_rates(rates, step)
        self.rt.launch(
            self._step, (stride // self.rt.lanes, 11), raw, gradients, moments, stride, rates16,
            np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON), group=self.rt.group(),
        )  # fmt: skip


@dataclass(frozen=True)
class DensityControl(checks.Checked):
    """When Gaussians are cloned, split and removed, and which. The unit of length is half the volume's longest side.

    ``every``: iterations between two rounds of cloning, splitting and removing; 0 keeps the first population. Rounds begin
    after ``start_iteration``, end before the fraction ``stop_fraction`` of the run, and add Gaussians up to
    ``max_gaussians``. A Gaussian whose statistic (``control_density``) reaches ``threshold`` is split if its longest scale
    exceeds ``split_scale``, else cloned. A split divides its scales by ``split_factor``. Gaussians fainter than
    ``prune_density`` times the FDK volume's 99.9th percentile are removed, and those whose longest scale is more than
    ``prune_aspect`` times their shortest (0: never). Such thin sheets and needles lie between the rays, where no measurement
    constrains them, and are visible in the volume."""

    PREFIX = "control."

    every: int = checks.ranged(100, 0, 1_000_000_000)
    start_iteration: int = checks.ranged(500, 0, 1_000_000_000)
    stop_fraction: float = checks.ranged(0.75, 0, 1)
    threshold: float = checks.ranged(3e-4, 0, 1e6)
    split_scale: float = checks.ranged(0.2, 0, 1e3)
    split_factor: float = checks.ranged(1.6, 1, 1e3)
    prune_density: float = checks.ranged(1e-5, 0, 1e6)
    prune_aspect: float = checks.ranged(50.0, 0, 1e9)
    max_gaussians: int = checks.ranged(500_000, 1, 100_000_000)

    def allows(self, scale: np.ndarray) -> np.ndarray:
        """Returns which Gaussians of scales (3, G) are not too thin for ``prune_aspect``, bool (G,)."""
        return np.asarray(scale.max(0) <= (self.prune_aspect or np.inf) * scale.min(0))

    def is_due(self, iteration: int, iterations: int) -> bool:
        """Returns whether a round of density control is due after ``iteration``, counted from 1, of ``iterations``."""
        inside = self.start_iteration < iteration < self.stop_fraction * iterations
        return self.every > 0 and inside and iteration % self.every == 0


@dataclass(eq=False)
class Population:
    """Raw parameters (11, G) and Adam's moments (2, 11, G) of the same Gaussians."""

    raw: np.ndarray
    moments: np.ndarray

    @property
    def count(self) -> int:
        return int(self.raw.shape[1])

    def take(self, index: np.ndarray) -> "Population":
        return Population(self.raw[:, index], self.moments[:, :, index])


def control_density(
    population: Population, statistic: np.ndarray, activation: Activation, control: DensityControl,
    box: np.ndarray, rng: np.random.Generator,
) -> Population:
    """Returns the population after one round of density control: cloned, split and pruned.

    statistic (G,): mean norm of dL/d(projected centre). box (2, 3): lowest and highest corner x y z; Gaussians centred
    outside are removed."""
    rows = activation.apply(population.raw)
    room = max(control.max_gaussians - statistic.size, 0)
    has_large_gradient = _strongest(statistic, control.threshold, room)
    is_large = rows[g.SCALE].max(0) > control.split_scale
    cloned = np.flatnonzero(has_large_gradient & ~is_large)
    split = np.flatnonzero(has_large_gradient & is_large)
    rows[g.DENSITY, cloned] *= 0.5
    copies, first = rows[:, cloned].copy(), _children(rows[:, split], control, rng)
    second = _children(rows[:, split], control, rng)
    changed = population.raw.copy()
    changed[:, cloned] = activation.invert(rows[:, cloned])
    new_raw = activation.invert(np.concatenate([copies, first, second], axis=1))
    # Two children replace a Gaussian that is split. A cloned Gaussian stays, and gets a copy.
    remaining = np.setdiff1d(np.arange(population.count), split)
    raw = np.concatenate([changed[:, remaining], new_raw], axis=1)
    # New Gaussians have no earlier gradients, so their moments are 0.
    fresh = np.zeros((2, g.ROWS, new_raw.shape[1]), population.moments.dtype)
    grown = Population(raw, np.concatenate([population.moments[:, :, remaining], fresh], axis=2))
    return prune(grown, activation, control, box)


def prune(
    population: Population, activation: Activation, control: DensityControl, box: np.ndarray
) -> Population:
    """Returns the population without Gaussians that are faint, too thin or outside the box. It is sorted by height, so that
    neighbours in memory project onto the same detector lines."""
    rows = activation.apply(population.raw)
    inside = np.all((rows[g.MEAN] >= box[0][:, None]) & (rows[g.MEAN] <= box[1][:, None]), axis=0)
    kept = np.flatnonzero(inside & (rows[g.DENSITY] >= control.prune_density) & control.allows(rows[g.SCALE]))
    return population.take(kept[np.argsort(population.raw[2, kept], kind="stable")])


def _strongest(statistic: np.ndarray, threshold: float, room: int) -> np.ndarray:
    """Returns which numbers in ``statistic`` reach the threshold, bool (G,). If more than ``room`` do, returns only the
    ``room`` largest."""
    chosen = np.zeros(statistic.shape, bool)
    chosen[np.argsort(-statistic, kind="stable")[:room]] = True
    return chosen & (statistic >= threshold)


def _children(rows: np.ndarray, control: DensityControl, rng: np.random.Generator) -> np.ndarray:
    """Draws one child of each Gaussian, both (11, S): smaller, half as dense, with a centre drawn from its parent."""
    child: np.ndarray = rows.copy()
    child[g.MEAN] += rotate(rows[g.QUATERNION], rng.normal(size=(3, rows.shape[1])) * rows[g.SCALE])
    child[g.SCALE] /= control.split_factor
    child[g.DENSITY] *= 0.5
    return child


def rotate(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Returns vectors (3, S) rotated by unit quaternions (4, S), w x y z."""
    w, axis = quaternion[0], quaternion[1:]
    cross = 2 * np.cross(axis, vector, axis=0)
    return np.asarray(vector + w * cross + np.cross(axis, cross, axis=0))
