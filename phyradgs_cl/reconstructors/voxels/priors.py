"""Priors of volumes by name, as proximal maps that start from where the last one ended."""

from collections.abc import Callable
from functools import partial
from typing import Any
from typing import Protocol as Interface

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.objective import DctProx, TvProx
from phyradgs_cl.objective.dct_prox import TURNS
from phyradgs_cl.reconstructors.checkpoint import count_of
from phyradgs_cl.reconstructors.method import imported
from phyradgs_cl.reconstructors.result import State, state_arrays
from phyradgs_cl.runtime import Runtime, Space

PRIORS = ("dct", "tv", "piccs", "none")
_TV_SHARE, _DCT_SHARE = 0.8, 1.5  # of the weight where both are in one step


class Prior(Interface):
    """A map x → argmin ½‖x' − x‖² + weight R(x'), x' ≥ 0 if asked, or what stands for one."""

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        """The map of a volume (nz, ny, nx) of ``space``; ``weight`` in 1/mm."""
        ...

    def state(self) -> dict[str, np.ndarray]:
        """What the next map starts from."""
        ...

    def restore(self, state: State) -> None: ...


Denoiser = Callable[[np.ndarray, float], np.ndarray]
"""(volume (nz, ny, nx) float32 in 1/mm, noise in 1/mm) → volume: a prior of one's own (plug-and-play)."""


def prior_of(
    prior: str | Denoiser, rt: Runtime, grid: Grid, tv_iterations: int, image: np.ndarray | None = None, share: float = 0.5
) -> Prior:
    """A prior by its name in ``PRIORS``, or one's own, itself or by ``package.module:function``; of piccs the prior image
    (nz, ny, nx) in 1/mm, and its share. InputError: it has none, or what is no function."""
    if callable(prior) or ":" in prior:
        own = prior if callable(prior) else imported(prior, "prior")
        if not callable(own):
            raise InputError("prior", checks.shown(own), "a function (volume, noise)")
        return OwnPrior(own)
    tv = TvPrior(TvProx(rt, grid.shape, axis_weights(grid)), tv_iterations)
    if prior == "tv":
        return tv
    if prior == "piccs":
        if image is None:
            remedy = "say --initial, or take prior=tv"
            raise InputError("--set prior=piccs", "no prior image", "a volume to start from", remedy)
        return Piccs(tv, TvPrior(TvProx(rt, grid.shape, axis_weights(grid)), tv_iterations), image, share)
    return TvAndDct(tv, DctProx(rt, grid.shape)) if prior == "dct" else NoPrior()


def axis_weights(grid: Grid) -> tuple[float, float, float]:
    """Weights (z, y, x) that make differences slopes, 1 along the finest axis."""
    finest = min(grid.voxel_size_mm)
    z, y, x = (finest / pitch for pitch in grid.voxel_size_mm)
    return z, y, x


class TvPrior:
    """Isotropic total variation."""

    def __init__(self, prox: TvProx, iterations: int) -> None:
        self.prox, self.iterations = prox, iterations

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        prox = partial(self.prox, weight=weight, iterations=self.iterations, nonnegative=nonnegative)
        return space.apply(prox, volume, self.prox.shape)

    def state(self) -> dict[str, np.ndarray]:
        return {"dual": self.prox.dual}

    def restore(self, state: State) -> None:
        (self.prox.dual,) = state_arrays(state, ["dual"])


class TvAndDct(TvPrior):
    """Total variation, then the shrinkage of block DCTs: alone the latter falls where it is run on."""

    def __init__(self, tv: TvPrior, shrink: DctProx) -> None:
        super().__init__(tv.prox, tv.iterations)
        self.shrink, self.turn = shrink, 0

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        smooth = super().__call__(space, volume, _TV_SHARE * weight, nonnegative=nonnegative)
        shrink = partial(self.shrink, threshold=_DCT_SHARE * weight, turn=self.turn, nonnegative=nonnegative)
        self.turn = (self.turn + 1) % len(TURNS)
        return space.apply(shrink, smooth, self.prox.shape)

    def state(self) -> dict[str, np.ndarray]:
        return {**super().state(), "turn": np.array(self.turn)}

    def restore(self, state: State) -> None:
        super().restore(state)
        self.turn = count_of(state, "turn", len(TURNS) - 1)


class Piccs:
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


class NoPrior:
    """Nothing but x ≥ 0."""

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        return space.add(volume, volume, 0.0, nonnegative=nonnegative)

    def state(self) -> dict[str, np.ndarray]:
        return {}

    def restore(self, state: State) -> None:
        pass


class OwnPrior:
    """A user's denoiser on the host, in the place of a proximal map (Venkatakrishnan, Bouman and Wohlberg 2013)."""

    def __init__(self, denoiser: Denoiser) -> None:
        self.denoiser = denoiser

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        before = space.numpy(volume)
        cleaned = np.asarray(self.denoiser(before, weight), np.float32)
        checks.shape("prior", cleaned, before.shape)
        return space.array(np.maximum(cleaned, 0) if nonnegative else cleaned)

    def state(self) -> dict[str, np.ndarray]:
        return {}

    def restore(self, state: State) -> None:
        pass
