"""Total variation over ranks: each has a slab of slices with a halo of its neighbours', and nobody the whole on its device.

What a slab's artificial ends spoil moves inwards by a slice an iteration and stays in the halo: every rank's own slices have
the bits that they have in the whole volume.
"""

from __future__ import annotations

from typing import Protocol as Interface

import numpy as np

from phyradgs_cl.objective import TvDescent, TvProx
from phyradgs_cl.parallel import Communicator, span
from phyradgs_cl.runtime import Runtime

Shape = tuple[int, int, int]
Weights = tuple[float, float, float]


class Prox(Interface):
    """A proximal map with its dual, as ``TvProx`` has it."""

    dual: np.ndarray

    def __call__(
        self, volume: np.ndarray, weight: float, iterations: int, *, nonnegative: bool
    ) -> np.ndarray: ...


class Descent(Interface):
    """Steps downhill, as ``TvDescent`` takes them."""

    def __call__(self, volume: np.ndarray, step: float, count: int) -> np.ndarray: ...


def tv_prox_for(rt: Runtime, shape: Shape, axis_weights: Weights, iterations: int) -> Prox:
    """The proximal map of volumes of ``shape`` (z, y, x), of at most so many iterations a call; over ranks in slabs."""
    if rt.ranks.size == 1:
        return TvProx(rt, shape, axis_weights)
    return SlabProx(rt, shape, axis_weights, iterations)


def tv_descent_for(rt: Runtime, shape: Shape) -> Descent:
    """Steps of TV descent for volumes of ``shape`` (z, y, x), over ranks where there are several."""
    return TvDescent(rt, shape) if rt.ranks.size == 1 else SlabDescent(rt, shape)


class Slab:
    """This rank's slices of ``depth``, and ``halo`` more on both sides as far as there are any."""

    def __init__(self, ranks: Communicator, depth: int, halo: int) -> None:
        self.ranks, self.depth, self.halo = ranks, depth, halo
        self.own = span(depth, ranks.size, ranks.rank)
        self.all = self._with_halo(ranks.rank)
        self.inner = slice(self.own.start - self.all.start, self.own.stop - self.all.start)
        """The own slices among all."""

    def _with_halo(self, rank: int) -> slice:
        own = span(self.depth, self.ranks.size, rank)
        if not len(own):
            return slice(own.start, own.start)
        return slice(max(own.start - self.halo, 0), min(own.stop + self.halo, self.depth))

    def surrounded(self, own: np.ndarray) -> np.ndarray:
        """The own slices (own, ...) with their halo (n, ...), from the ranks that have it."""
        parts = []
        for rank in range(self.ranks.size):
            asked = self._with_halo(rank)
            first, stop = max(asked.start, self.own.start), min(asked.stop, self.own.stop)
            parts.append(
                np.ascontiguousarray(own[first - self.own.start : max(stop, first) - self.own.start])
            )
        return np.concatenate(self.ranks.exchange(parts))


class SlabProx:
    """``TvProx`` in slabs: as many slices of halo as iterations, and one."""

    def __init__(self, rt: Runtime, shape: Shape, axis_weights: Weights, iterations: int) -> None:
        self.slab = Slab(rt.ranks, shape[0], iterations + 1)
        slices = self.slab.all.stop - self.slab.all.start
        self._shape, self._iterations = shape, iterations
        self._prox = TvProx(rt, (slices, *shape[1:]), axis_weights) if slices else None

    @property
    def dual(self) -> np.ndarray:
        """The dual field (3, nz, ny, nx) along x, y, z, on every rank."""
        return np.moveaxis(self.slab.ranks.join(self._own_dual()), 0, 1)

    @dual.setter
    def dual(self, values: np.ndarray) -> None:
        if self._prox is not None:
            self._prox.dual = values[:, self.slab.all]

    def __call__(
        self, volume: np.ndarray, weight: float, iterations: int, *, nonnegative: bool
    ) -> np.ndarray:
        """The map of a volume (z, y, x), float32, after ``iterations`` from the last dual; whole on every rank."""
        assert iterations <= self._iterations, "the halo is too thin"
        own = np.empty((0, *self._shape[1:]), np.float32)
        if self._prox is not None:
            made = self._prox(volume[self.slab.all], weight, iterations, nonnegative=nonnegative)
            own = made[self.slab.inner]
        whole = self.slab.ranks.join(own)
        surrounded = self.slab.surrounded(self._own_dual())
        if self._prox is not None:
            self._prox.dual = np.ascontiguousarray(np.moveaxis(surrounded, 1, 0))
        return whole

    def _own_dual(self) -> np.ndarray:
        """(own, 3, ny, nx)"""
        if self._prox is None:
            return np.empty((0, 3, *self._shape[1:]), np.float32)
        return np.moveaxis(self._prox.dual[:, self.slab.inner], 0, 1)


class SlabDescent:
    """``TvDescent`` in slabs, whose halo of a slice is fetched anew for every step."""

    def __init__(self, rt: Runtime, shape: Shape) -> None:
        self.slab = Slab(rt.ranks, shape[0], 1)
        slices = self.slab.all.stop - self.slab.all.start
        self._descent = TvDescent(rt, (slices, *shape[1:])) if slices else None

    def __call__(self, volume: np.ndarray, step: float, count: int) -> np.ndarray:
        """``count`` steps of Euclidean length ``step`` (1/mm) downhill; a whole volume (z, y, x) on every rank."""
        slab = self.slab
        own = volume[slab.own.start : slab.own.stop].astype(np.float32, copy=True)
        for _ in range(count):
            surrounded = slab.surrounded(own)
            gradient = np.zeros_like(own)
            if self._descent is not None:
                gradient = self._descent.gradient(surrounded)[slab.inner]
            squares = np.array([np.sum(part.astype(np.float64) ** 2) for part in gradient])
            length = float(np.sqrt(slab.ranks.join(squares).sum()))
            if length == 0:
                break
            own -= np.float32(step / length) * gradient
        return slab.ranks.join(own)


def tv_device_bytes(shape: Shape, ranks: int, method: str, iterations: int) -> int:
    """What the total variation of ``method`` holds on a rank's device, at most."""
    nz, ny, nx = shape
    volumes, halo = {"fista-tv": (8, iterations + 1), "asd-pocs": (2, 1)}.get(method, (0, 0))
    slices = nz if ranks == 1 else min(-(-nz // ranks) + 2 * halo, nz)
    return 4 * volumes * slices * ny * nx
