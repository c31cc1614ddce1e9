"""The priors of ``fista``, as proximal maps. A new one is a class and a line of ``PRIORS``; its map is in ``objective``."""

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.objective import DctProx, RidgeStep, TvProx, learned_ridge
from phyradgs_cl.objective.dct_prox import TURNS
from phyradgs_cl.objective.ridge import EDGE as RIDGE_EDGE
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.method import imported
from phyradgs_cl.reconstructors.result import function_name
from phyradgs_cl.runtime import Runtime, Space

# shares of the prior's weight, by the prior (docs/results/settings.md)
_TV_ALONE, _TV_BEFORE_DCT, _DCT = 1.6, 0.8, 1.5
_TV_AT_REST, _DCT_AT_REST = 0.5, 1.35  # before ridge, of scans that stop for each projection
_RIDGE_NOISE, _RIDGE_LENGTH, _RIDGE_EVERY = 17.0, 0.5, 4  # noise that the step assumes, its length, and maps for each step
_RIDGE_NOISE_AT_REST = 20.0
_USUAL_NOISE, _LEAST_NOISE = 0.01, 0.001  # of line integrals: where the numbers at rest hold, and the least that they follow
_LEAST_NOISE_SHARE = 0.1  # for the ridge step of scans without noise
_SUBVOXELS, _SUBVOXELS_WITH_RIDGE = 2 / 3, 0.85  # share of the smaller voxels in the result


@dataclass(frozen=True, eq=False)
class PriorInputs:
    """The arguments of a prior: device, grid, and for piccs its image (nz, ny, nx) in 1/mm and the weight of the change.

    tv_iterations: dual iterations per map. is_fly: of the scan, whose frames expose for an arc. noise: of its line
    integrals, behind the object."""

    rt: Runtime
    grid: Grid
    tv_iterations: int
    image: np.ndarray | None = None
    share: float = 0.5
    is_fly: bool = False
    noise: float = _USUAL_NOISE

    def tv(self, share: float = 1.0) -> "TvPrior":
        return TvPrior(TvProx(self.rt, self.grid.shape, axis_weights(self.grid)), self.tv_iterations, share)

    def tv_and_dct(self, tv_share: float = _TV_BEFORE_DCT, dct_share: float = _DCT) -> "TvAndDct":
        return TvAndDct(self.tv(tv_share), DctProx(self.rt, self.grid.shape), dct_share)

    def dct_then_ridge(self) -> "Prior":
        """At rest the step does more of the work, most of it where noise is low; flat bodies lose by that on fly-scans."""
        if min(self.grid.shape) < RIDGE_EDGE:
            return self.tv_and_dct()
        ridge = RidgeStep(self.rt, self.grid.shape, learned_ridge())
        if self.is_fly:
            return ThenRidge(self.tv_and_dct(), ridge, _RIDGE_NOISE)
        relative = (max(self.noise, _LEAST_NOISE) / _USUAL_NOISE) ** (1 / 6)
        before = self.tv_and_dct(_TV_AT_REST * relative, _DCT_AT_REST)
        return ThenRidge(before, ridge, _RIDGE_NOISE_AT_REST / relative)


class Prior:
    """A map x → argmin ½‖x' − x‖² + weight R(x'), x' ≥ 0 if asked, or an approximation of it.

    A subclass that starts from its last result keeps it in ``state``. This class is the prior none: x ≥ 0 alone."""

    VOLUMES: ClassVar[int] = 0
    """How many more volumes the prior holds than ``dct``."""

    noise_share = 1.0
    """The share of noise in the weights of the present pass; the error of voxels at edges is the rest."""

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        """Maps a volume (nz, ny, nx) of ``space``; ``weight`` in 1/mm."""
        return space.add(volume, volume, 0.0, nonnegative=nonnegative)

    def state(self) -> dict[str, np.ndarray]:
        """Returns the arrays that the next map starts from."""
        return {}

    def restore(self, state: State) -> None:
        """Continues from ``state``."""


class TvPrior(Prior):
    """Isotropic total variation, its weight multiplied by ``share``."""

    def __init__(self, prox: TvProx, iterations: int, share: float = 1.0) -> None:
        self.prox, self.iterations, self.share = prox, iterations, share

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        prox = partial(self.prox, weight=self.share * weight, iterations=self.iterations, nonnegative=nonnegative)
        return space.apply(prox, volume, self.prox.shape)

    def state(self) -> dict[str, np.ndarray]:
        return {"dual": self.prox.dual}

    def restore(self, state: State) -> None:
        self.prox.dual = state["dual"]


class TvAndDct(Prior):
    """Total variation, then a shrinkage of block cosine transforms, which follows best from a smooth volume.

    share: the threshold of the shrinkage over the prior's weight."""

    def __init__(self, tv: TvPrior, shrink: DctProx, share: float) -> None:
        self.tv, self.shrink, self.share, self.turn = tv, shrink, share, 0

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        smooth = self.tv(space, volume, weight, nonnegative=nonnegative)
        shrink = partial(self.shrink, threshold=self.share * weight, turn=self.turn, nonnegative=nonnegative)
        # the next map takes the next quarter of the shifts: four maps have all of them
        self.turn = (self.turn + 1) % len(TURNS)
        return space.apply(shrink, smooth, self.tv.prox.shape)

    def state(self) -> dict[str, np.ndarray]:
        return {**self.tv.state(), "turn": np.array(self.turn)}

    def restore(self, state: State) -> None:
        self.tv.restore(state)
        self.turn = int(state["turn"])


class ThenRidge(Prior):
    """Another prior, and after every fourth of its maps a step down the learned ridge regulariser."""

    VOLUMES = RidgeStep.VOLUMES

    def __init__(self, before: Prior, ridge: RidgeStep, noise_factor: float) -> None:
        """noise_factor: the noise that the step assumes, over the prior's weight."""
        self.before, self.ridge, self.noise_factor = before, ridge, noise_factor
        self.maps = 0  # since the last step

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        volume = self.before(space, volume, weight, nonnegative=nonnegative)
        self.maps = (self.maps + 1) % _RIDGE_EVERY
        if self.maps:
            return volume
        # edges are no noise: steps that took all of the weight for it lost 0.2 dB with 180 views
        sigma = self.noise_factor * weight * max(self.noise_share, _LEAST_NOISE_SHARE)
        step = partial(self.ridge, sigma=sigma, step=_RIDGE_LENGTH, nonnegative=nonnegative)
        return space.apply(step, volume, self.ridge.shape)

    def state(self) -> dict[str, np.ndarray]:
        return {**self.before.state(), "maps": np.array(self.maps)}

    def restore(self, state: State) -> None:
        self.before.restore(state)
        self.maps = int(state["maps"])


class Piccs(Prior):
    """(1 − share) TV(x) + share TV(x − image), as one map after the other.

    Prior image constrained compressed sensing: Chen, Tang and Leng, Med. Phys. 35 (2008) 660."""

    def __init__(self, inputs: PriorInputs) -> None:
        if inputs.image is None:
            raise InputError("--prior piccs", "no prior image", "a volume to start from", "say --initial, or take tv")
        self.plain, self.change = inputs.tv(), inputs.tv()
        self.image, self.share = inputs.image, inputs.share
        self._image_in_space: Any = None

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        if self._image_in_space is None:
            self._image_in_space = space.array(np.ascontiguousarray(self.image, np.float32))
        volume = self.plain(space, volume, (1 - self.share) * weight, nonnegative=nonnegative)
        change = space.add(volume, self._image_in_space, -1.0)
        # a change may be negative; the sum below may not
        change = self.change(space, change, self.share * weight, nonnegative=False)
        return space.add(change, self._image_in_space, 1.0, nonnegative=nonnegative)

    def state(self) -> dict[str, np.ndarray]:
        return {**self.plain.state(), "dual_of_change": self.change.prox.dual}

    def restore(self, state: State) -> None:
        self.plain.restore(state)
        self.change.prox.dual = state["dual_of_change"]


Denoiser = Callable[[np.ndarray, float], np.ndarray]
"""(volume (nz, ny, nx) float32 in 1/mm, noise in 1/mm) → volume: a user's own prior (plug-and-play)."""


class OwnPrior(Prior):
    """A user's denoiser on the host in place of a proximal map (Venkatakrishnan, Bouman and Wohlberg 2013)."""

    def __init__(self, denoiser: Denoiser) -> None:
        self.denoiser, self.subject = denoiser, f"--prior {function_name(denoiser)}"

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        noisy = space.numpy(volume)
        try:
            result = self.denoiser(noisy, weight)
        except Exception as error:  # a user's function may raise anything
            at = traceback.extract_tb(error.__traceback__)[-1]
            message = f"{type(error).__name__}: {error} ({at.filename}, line {at.lineno})"
            raise InputError(self.subject, message, "a function of (volume, noise) that returns a volume") from error
        clean = checks.numbers(self.subject, result, noisy.shape).astype(np.float32)
        return space.array(np.maximum(clean, 0) if nonnegative else clean)


PRIORS: dict[str, Callable[[PriorInputs], Prior]] = {
    "ridge": PriorInputs.dct_then_ridge,
    "dct": PriorInputs.tv_and_dct,
    "tv": lambda inputs: inputs.tv(_TV_ALONE),
    "piccs": Piccs,
    "none": lambda inputs: Prior(),
}


def prior_of(prior: str | Denoiser, inputs: PriorInputs) -> Prior:
    """Returns a prior by its name in ``PRIORS``, or a user's function, itself or by ``package.module:function``.

    Raises InputError for a name that is no function, and for piccs without an image."""
    if isinstance(prior, str) and prior in PRIORS:
        return PRIORS[prior](inputs)
    own = imported(prior, "--prior") if isinstance(prior, str) else prior
    if not callable(own):
        raise InputError("--prior", checks.short_repr(own), "a function (volume, noise)")
    return OwnPrior(own)


def volumes_of(prior: str | Denoiser) -> int:
    """Returns how many more volumes a prior holds than ``dct``."""
    return ThenRidge.VOLUMES if prior == "ridge" else 0


def subvoxel_share(prior: str | Denoiser, shape: tuple[int, int, int]) -> float:
    """Returns the share of smaller voxels (z, y, x) in a result. Larger ones average noise, which ridge leaves less of."""
    return _SUBVOXELS_WITH_RIDGE if prior == "ridge" and min(shape) >= RIDGE_EDGE else _SUBVOXELS


def axis_weights(grid: Grid) -> tuple[float, float, float]:
    """Returns weights (z, y, x) that turn differences into slopes, 1 along the finest axis."""
    finest = min(grid.voxel_size_mm)
    z, y, x = (finest / pitch for pitch in grid.voxel_size_mm)
    return z, y, x
