"""Priors of volumes by name, as proximal maps that start from where the last one ended."""

import traceback
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.objective import DctProx, NonlocalStep, TvProx
from phyradgs_cl.objective.dct_prox import TURNS
from phyradgs_cl.reconstructors.checkpoint import count_of
from phyradgs_cl.reconstructors.method import imported
from phyradgs_cl.reconstructors.result import State, function_name, state_arrays
from phyradgs_cl.runtime import Runtime, Space

_ALIKE = {"nonlocal": 300.0, "nonlocal+dct": 100.0}  # h of the nonlocal weights over the weight
_STEP = 0.01  # how far a map goes down their quadratic
PRIORS = ("dct", "tv", *_ALIKE, "piccs", "none")
_TV_SHARE, _DCT_SHARE = 0.8, 1.5  # of the weight where both are in one step
_TV_ALONE_SHARE = 1.6  # without transforms


class Prior:
    """A map x → argmin ½‖x' − x‖² + weight R(x'), x' ≥ 0 if asked, or what stands for one; by itself without a memory."""

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        """The map of a volume (nz, ny, nx) of ``space``; ``weight`` in 1/mm."""
        raise NotImplementedError

    def end_pass(self, space: Space[Any], volume: Any) -> None:
        """Tells of the volume after a pass over all frames."""

    def state(self) -> dict[str, np.ndarray]:
        """What the next map starts from."""
        return {}

    def restore(self, state: State) -> None:
        """The inverse of ``state``."""


Denoiser = Callable[[np.ndarray, float], np.ndarray]
"""(volume (nz, ny, nx) float32 in 1/mm, noise in 1/mm) → volume: a prior of one's own (plug-and-play)."""


def prior_of(
    prior: str | Denoiser,
    rt: Runtime,
    grid: Grid,
    tv_iterations: int,
    passes: int,
    image: np.ndarray | None = None,
    share: float = 0.5,
) -> Prior:
    """A prior by its name in ``PRIORS``, or one's own, itself or by ``package.module:function``, for a run of so many
    ``passes``; of piccs the prior image (nz, ny, nx) in 1/mm, and its share. InputError: without one, or no function."""
    if callable(prior) or ":" in prior:
        own = prior if callable(prior) else imported(prior, "--prior")
        if not callable(own):
            raise InputError("--prior", checks.shown(own), "a function (volume, noise)")
        return OwnPrior(own)
    if prior == "none":
        return NoPrior()
    prox = TvProx(rt, grid.shape, axis_weights(grid))
    if prior == "tv":
        return TvPrior(prox, tv_iterations, _TV_ALONE_SHARE)
    if prior == "piccs":
        if image is None:
            raise InputError("--prior piccs", "no prior image", "a volume to start from", "say --initial, or take tv")
        change = TvProx(rt, grid.shape, axis_weights(grid))
        return Piccs(TvPrior(prox, tv_iterations), TvPrior(change, tv_iterations), image, share)
    if prior == "nonlocal":
        local = TvPrior(prox, tv_iterations, _TV_ALONE_SHARE)
    else:
        local = TvAndDct(prox, tv_iterations, DctProx(rt, grid.shape))
    return Nonlocal(local, NonlocalStep(rt, grid.shape), _ALIKE[prior], passes) if prior in _ALIKE else local


def volumes_of(prior: str | Denoiser) -> int:
    """How many more volumes a prior holds than ``dct``."""
    return NonlocalStep.VOLUMES if prior in _ALIKE else 0


def axis_weights(grid: Grid) -> tuple[float, float, float]:
    """Weights (z, y, x) that make differences slopes, 1 along the finest axis."""
    finest = min(grid.voxel_size_mm)
    z, y, x = (finest / pitch for pitch in grid.voxel_size_mm)
    return z, y, x


class TvPrior(Prior):
    """Isotropic total variation, with a share of the weight."""

    def __init__(self, prox: TvProx, iterations: int, share: float = 1.0) -> None:
        self.prox, self.iterations, self.share = prox, iterations, share

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        prox = partial(self.prox, weight=self.share * weight, iterations=self.iterations, nonnegative=nonnegative)
        return space.apply(prox, volume, self.prox.shape)

    def state(self) -> dict[str, np.ndarray]:
        return {"dual": self.prox.dual}

    def restore(self, state: State) -> None:
        (self.prox.dual,) = state_arrays(state, ["dual"])


class TvAndDct(TvPrior):
    """Total variation, then the shrinkage of block DCTs: alone the latter falls where it is run on."""

    def __init__(self, prox: TvProx, iterations: int, shrink: DctProx) -> None:
        super().__init__(prox, iterations, _TV_SHARE)
        self.shrink, self.turn = shrink, 0

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        smooth = super().__call__(space, volume, weight, nonnegative=nonnegative)
        shrink = partial(self.shrink, threshold=_DCT_SHARE * weight, turn=self.turn, nonnegative=nonnegative)
        self.turn = (self.turn + 1) % len(TURNS)
        return space.apply(shrink, smooth, self.prox.shape)

    def state(self) -> dict[str, np.ndarray]:
        return {**super().state(), "turn": np.array(self.turn)}

    def restore(self, state: State) -> None:
        super().restore(state)
        self.turn = count_of(state, "turn", len(TURNS) - 1)


class Nonlocal(Prior):
    """A step down a nonlocal quadratic, then another map. Its weights come from the volume after a quarter of the passes,
    and anew after half of them: weights that follow the volume for ever sharpen what is not there."""

    def __init__(self, then: Prior, smooth: NonlocalStep, alike: float, passes: int) -> None:
        self.then, self.smooth, self.alike, self.passes = then, smooth, alike, passes
        self._done, self._is_learned = 0, False
        self._guide: np.ndarray | None = None
        self._h = 0.0  # of the guide's weights; 0: not known yet

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        if self._guide is not None and weight > 0:
            if not self._is_learned:
                self._h = self._h or self.alike * weight
                self.smooth.learn(self._guide, self._h)
                self._is_learned = True
            volume = space.apply(partial(self.smooth, step=_STEP), volume, self.smooth.shape)
        return self.then(space, volume, weight, nonnegative=nonnegative)

    def end_pass(self, space: Space[Any], volume: Any) -> None:
        self._done += 1
        if self._done in (-(-self.passes // 4), -(-self.passes // 2)):
            self._guide, self._is_learned, self._h = space.numpy(volume), False, 0.0

    def state(self) -> dict[str, np.ndarray]:
        guide = np.zeros(self.smooth.shape, np.float32) if self._guide is None else self._guide
        return {**self.then.state(), "guide": guide, "h": np.array(self._h), "passes": np.array(self._done)}

    def restore(self, state: State) -> None:
        self.then.restore(state)
        guide, h = state_arrays(state, ["guide", "h"])
        self._done = count_of(state, "passes", self.passes)
        self._guide, self._is_learned, self._h = guide if guide.any() else None, False, float(h)


class Piccs(Prior):
    """Total variation of the volume, and that of what it differs from a prior image by: (1 − share) TV(x) + share TV(x − i),
    one map after the other (prior image constrained compressed sensing; Chen, Tang and Leng, Med. Phys. 35 (2008) 660)."""

    def __init__(self, plain: TvPrior, change: TvPrior, image: np.ndarray, share: float) -> None:
        self.plain, self.change, self.image, self.share = plain, change, image, share
        self._there: Any = None

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        if self._there is None:
            self._there = space.array(np.ascontiguousarray(self.image, np.float32))
        volume = self.plain(space, volume, (1 - self.share) * weight, nonnegative=nonnegative)
        change = self.change(space, space.add(volume, self._there, -1.0), self.share * weight, nonnegative=False)
        return space.add(change, self._there, 1.0, nonnegative=nonnegative)

    def state(self) -> dict[str, np.ndarray]:
        return {**self.plain.state(), "dual_of_change": self.change.prox.dual}

    def restore(self, state: State) -> None:
        self.plain.restore(state)
        (self.change.prox.dual,) = state_arrays(state, ["dual_of_change"])


class NoPrior(Prior):
    """Nothing but x ≥ 0."""

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        return space.add(volume, volume, 0.0, nonnegative=nonnegative)


class OwnPrior(Prior):
    """A user's denoiser on the host, in the place of a proximal map (Venkatakrishnan, Bouman and Wohlberg 2013)."""

    def __init__(self, denoiser: Denoiser) -> None:
        self.denoiser, self.subject = denoiser, f"--prior {function_name(denoiser)}"

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        before = space.numpy(volume)
        try:
            made = self.denoiser(before, weight)
        except Exception as error:  # whatever somebody's function does
            at = traceback.extract_tb(error.__traceback__)[-1]
            found = f"{type(error).__name__}: {error} ({at.filename}, line {at.lineno})"
            raise InputError(self.subject, found, "a function of (volume, noise) that returns a volume") from error
        cleaned = checks.numbers(self.subject, made, before.shape).astype(np.float32)
        return space.array(np.maximum(cleaned, 0) if nonnegative else cleaned)
