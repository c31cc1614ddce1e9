"""The priors of ``fista`` as proximal maps, and their weight, relative to the error of the data term's gradient. To add a
prior, add a line to ``PRIORS``, with a subclass of ``Prior`` whose map is in ``objective``, or ``OwnPrior`` of a function.

A pixel differs from the projection of the best volume by its noise and, at edges, by the discretisation error of voxels.
Both reach the gradient through Aᵀ. The constants are fitted (docs/results/settings.md)."""

import math
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.detector.noise_level import noise_behind
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.objective import DctProx, RidgeStep, TvProx, learned_ridge
from phyradgs_cl.objective.dct_prox import TURNS
from phyradgs_cl.objective.ridge import EDGE as RIDGE_EDGE
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.method import imported
from phyradgs_cl.reconstructors.result import function_name
from phyradgs_cl.reconstructors.voxels.system import System
from phyradgs_cl.runtime import Runtime, Space

# (Length of a path)/(standard deviation of five positions on it, at even times from its start to its end).
_SPREAD = 2.83
_EDGES = 0.09  # (error of a ray's path length in the object, because voxels show edges coarsely)/(voxel's side)
_LEAST = 1e-4  # least weight of the prior, as a fraction of the largest value of Aᵀp: without noise it would be 0
# The following settings of the priors were measured (docs/results/settings.md).
_TV_ALONE = 1.6  # (weight of TV in the prior ``tv``)/(prior's weight)
_TV_BEFORE_DCT = 0.8  # (weight of TV in the prior ``dct``)/(prior's weight)
_DCT = 1.5  # (threshold of the block cosine transforms in the prior ``dct``)/(prior's weight)
_TV_AT_REST = 0.5  # (weight of TV before ridge steps)/(prior's weight), for scans that stop for each projection
_DCT_AT_REST = 1.35  # (threshold of the cosine transforms before ridge steps)/(prior's weight), for scans that stop
_RIDGE_NOISE = 17.0  # (noise that a ridge step assumes)/(part of the prior's weight that is due to noise), for fly-scans
_RIDGE_NOISE_AT_REST = 20.0  # (noise that a ridge step assumes)/(part of the weight due to noise), for scans that stop
_RIDGE_LENGTH = 0.5  # length of a ridge step: factor on the regulariser's gradient
_RIDGE_EVERY = 4  # number of maps of the prior ``dct`` from one ridge step to the next
# _TV_AT_REST and _RIDGE_NOISE_AT_REST hold for this noise of line integrals. For another noise, _TV_AT_REST is multiplied,
# and _RIDGE_NOISE_AT_REST divided, by (noise/_USUAL_NOISE)^(1/6).
_USUAL_NOISE = 0.01
_LEAST_NOISE = 0.001  # least noise of line integrals that the prior ``ridge`` assumes, because some scans have none
_LEAST_NOISE_SHARE = 0.1  # a ridge step takes at least this fraction of the prior's weight as noise: some scans have none
_SUBVOXELS = 2 / 3  # weight of the smaller voxels in the result; the larger voxels of earlier passes have the rest
_SUBVOXELS_WITH_RIDGE = 0.85  # weight of the smaller voxels in the result with the prior ``ridge``: it leaves less noise


@dataclass(frozen=True)
class FrameError:
    """The error of a pixel that no volume on the grid explains.

    noise: standard deviation of its line integral. edges_mm: (discretisation error of a line integral at edges)/(density
    there in 1/mm)."""

    noise: float
    edges_mm: float = 0.0


def frame_error(scan: Scan, motion: Motion) -> FrameError:
    """Estimates the error of a scan's pixels on its grid. Motion blur lowers the part of the error that edges cause."""
    voxel_mm = max(scan.grid.voxel_size_mm[1:])
    edges_mm = _EDGES * voxel_mm / math.sqrt(1 + _blur_mm(scan, motion) / voxel_mm)
    return FrameError(noise_behind(np.asarray(scan.projections, np.float32), scan.valid), edges_mm)


def _blur_mm(scan: Scan, motion: Motion) -> float:
    """Returns the length in mm of the motion blur in a middle line, half-way between the volume's centre and its side."""
    cells = motion.cells(scan, scan.frames // 2).still()
    line = cells.lines // 2
    serving = [c for c, lines in enumerate(cells.ranges) if lines.start <= line < lines.stop]
    weights = np.array([cells.weights_of(c)[line - cells.line_start[c]] for c in serving])
    sources_mm = cells.pose[serving, :3]  # a direction of length 1 in a parallel beam
    if not scan.is_parallel:
        sources_mm = sources_mm - scan.grid.offset_mm[::-1]
    apart_mm = sources_mm - weights @ sources_mm / weights.sum()
    turn_rad = _SPREAD * np.sqrt(weights @ (apart_mm**2).sum(1) / weights.sum()) / np.linalg.norm(sources_mm[0])
    return float(turn_rad * max(scan.grid.size_mm[1:]) / 4)


def adjoint_response(system: System) -> tuple[float, float]:
    """Returns how strongly the backprojection Aᵀ e responds to errors e of frames, in mm, in the middle half of each axis:
    its standard deviation if e is independent noise with standard deviation 1, and its mean if e is 1 in all rays."""
    noise = np.random.default_rng(0).standard_normal(system.measured.shape, np.float32)
    by_noise = system.adjoint(system.masked(system.apply_weights(system.space.array(noise))))
    by_ones = system.column_sums()
    middle = tuple(slice(n // 4, n - n // 4) for n in system.volume_shape)
    in_noise, in_ones = (system.space.numpy(volume)[middle] for volume in (by_noise, by_ones))
    return float(in_noise.std(dtype=np.float64)), float(in_ones.mean(dtype=np.float64))


class PriorWeight:
    """The weight of a prior: ``strength`` times the estimated error of the data term's gradient Aᵀ(p − A x). One part of
    this error comes from noise. The other comes from edges inside voxels, and is proportional to the object's density."""

    def __init__(self, system: System, error: FrameError, strength: float) -> None:
        self.space, self.error, self.strength = system.space, error, strength
        gradient = system.adjoint(system.apply_weights(system.measured))
        self.least = _LEAST * system.space.largest(gradient, absolute=True)
        self.noise_mm, self.common_mm = adjoint_response(system)

    def at(self, volume: Any) -> float:
        """Returns the prior's weight, in mm as the data term's gradient, at a volume (nz, ny, nx) in 1/mm."""
        by_noise = self.error.noise * self.noise_mm
        by_edges = self.error.edges_mm * _density(self.space, volume) * self.common_mm
        return max(self.strength * math.hypot(by_noise, by_edges), self.least)

    def noise_share(self, weight: float) -> float:
        """Returns the fraction of ``weight`` due to noise, 0 to 1. With many views or photons most of it is due to edges."""
        by_noise = self.strength * self.error.noise * self.noise_mm
        return min(by_noise / weight, 1.0) if weight > 0 else 1.0  # frames of zeros give a weight of 0


def _density(space: Space[Any], volume: Any) -> float:
    """Returns the mean of a volume's values x weighted by x², in 1/mm: Σ x³ / Σ x², to which air adds little."""
    squares = space.inner(volume, volume)
    return max(space.inner(space.multiply(volume, volume), volume) / squares, 0.0) if squares > 0 else 0.0


@dataclass(frozen=True, eq=False)
class PriorInputs:
    """What a prior needs.

    - tv_iterations: dual iterations per map of total variation. is_fly: frames expose over an arc (fly-scan).
    - noise: standard deviation of line integrals behind the object.
    - image (nz, ny, nx) in 1/mm: the prior image of the prior piccs. share: weight, 0 to 1, of the change from image."""

    rt: Runtime
    grid: Grid
    tv_iterations: int
    image: np.ndarray | None = None
    share: float = 0.5
    is_fly: bool = False
    noise: float = _USUAL_NOISE

    def tv(self, share: float = 1.0, name: str = "dual") -> "TvPrior":
        return TvPrior(TvProx(self.rt, self.grid.shape, axis_weights(self.grid)), self.tv_iterations, share, name)

    def tv_and_dct(self, tv_share: float = _TV_BEFORE_DCT, dct_share: float = _DCT) -> "TvAndDct":
        return TvAndDct(self.tv(tv_share), DctProx(self.rt, self.grid.shape), dct_share)

    def dct_then_ridge(self) -> "Prior":
        """Returns ``dct`` with steps of the learned ridge regulariser, or ``dct`` alone on grids too small for them.

        For scans that stop for each projection the ridge steps are stronger, and grow as the noise falls. In fly-scans
        stronger steps would lower the quality of slab-shaped objects."""
        if min(self.grid.shape) < RIDGE_EDGE:
            return self.tv_and_dct()
        ridge = RidgeStep(self.rt, self.grid.shape, learned_ridge())
        if self.is_fly:
            return ThenRidge(self.tv_and_dct(), ridge, _RIDGE_NOISE)
        relative = (max(self.noise, _LEAST_NOISE) / _USUAL_NOISE) ** (1 / 6)
        before = self.tv_and_dct(_TV_AT_REST * relative, _DCT_AT_REST)
        return ThenRidge(before, ridge, _RIDGE_NOISE_AT_REST / relative)


class Prior:
    """A proximal map, from x to argmin over x' of ½‖x' − x‖² + weight R(x'), x' ≥ 0 if asked, or an approximation of it.

    A subclass that needs numbers of its last call lists them in ``NUMBERS``; one that consists of other priors lists these
    in ``parts``. This class is the prior ``none``, with R = 0."""

    NUMBERS: ClassVar[tuple[str, ...]] = ()
    parts: tuple["Prior", ...] = ()
    noise_share = 1.0
    """Fraction, 0 to 1, of this pass's weight that is due to noise; the rest is due to the discretisation of edges."""

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        """Maps a volume (nz, ny, nx) of ``space``. weight, in 1/mm: that of one short gradient step, about 1/50 of the
        volume's noise. nonnegative: clips the result at 0."""
        return space.add(volume, volume, 0.0, nonnegative=nonnegative)

    def state(self) -> dict[str, np.ndarray]:
        own = {name: np.array(getattr(self, name)) for name in self.NUMBERS}
        return {name: array for one in (*(part.state() for part in self.parts), own) for name, array in one.items()}

    def restore(self, state: State) -> None:
        """Continues from the arrays that ``state`` returned."""
        for part in self.parts:
            part.restore(state)
        for name in self.NUMBERS:
            setattr(self, name, state[name].item())


class TvPrior(Prior):
    """The prior tv: isotropic total variation, weighted by ``share`` times the prior's weight. name: its dual in states."""

    def __init__(self, prox: TvProx, iterations: int, share: float = 1.0, name: str = "dual") -> None:
        self.prox, self.iterations, self.share, self.name = prox, iterations, share, name

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        out = space.place(self.prox.shape)
        return self.prox(volume, self.share * weight, self.iterations, nonnegative=nonnegative, out=out)

    def state(self) -> dict[str, np.ndarray]:
        return {self.name: self.prox.dual}

    def restore(self, state: State) -> None:
        self.prox.dual = state[self.name]


class TvAndDct(Prior):
    """The prior dct: total variation (TV), then a shrinkage of block cosine transforms, which works best after TV.

    share: (threshold of the shrinkage)/(weight of the prior)."""

    NUMBERS = ("turn",)

    def __init__(self, tv: TvPrior, shrink: DctProx, share: float) -> None:
        self.tv, self.shrink, self.share, self.turn = tv, shrink, share, 0
        self.parts = (tv,)

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        smooth = self.tv(space, volume, weight, nonnegative=nonnegative)
        turn, out = self.turn, space.place(self.shrink.shape)
        # each map takes the next quarter of the blocks' shifts, so that four maps take them all
        self.turn = (turn + 1) % len(TURNS)
        return self.shrink(smooth, self.share * weight, turn, nonnegative=nonnegative, out=out)


class ThenRidge(Prior):
    """The prior ridge: the map of the prior ``before`` and, after every fourth map, a step down the ridge regulariser."""

    NUMBERS = ("maps",)

    def __init__(self, before: Prior, ridge: RidgeStep, noise_factor: float) -> None:
        """Joins both maps. noise_factor: (noise that the ridge step assumes)/(part of the weight that is due to noise)."""
        self.before, self.ridge, self.noise_factor = before, ridge, noise_factor
        self.parts = (before,)
        self.maps = 0  # number of maps since the last ridge step

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        volume = self.before(space, volume, weight, nonnegative=nonnegative)
        self.maps = (self.maps + 1) % _RIDGE_EVERY
        if self.maps:
            return volume
        # only a part of the weight is due to noise: steps that counted the part of edges as noise lost 0.2 dB (180 views)
        sigma = self.noise_factor * weight * max(self.noise_share, _LEAST_NOISE_SHARE)
        out = space.place(self.ridge.shape)
        return self.ridge(volume, sigma=sigma, step=_RIDGE_LENGTH, nonnegative=nonnegative, out=out)


class Piccs(Prior):
    """The prior piccs: (1 − share) TV(x) + share TV(x − image), as the map of the first term and then of the second.

    Prior image constrained compressed sensing: Chen, Tang and Leng, Med. Phys. 35 (2008) 660."""

    def __init__(self, inputs: PriorInputs) -> None:
        if inputs.image is None:
            raise InputError("--prior piccs", "no prior image", "a volume to start from", "say --initial, or take tv")
        self.parts = self.plain, self.change = inputs.tv(), inputs.tv(name="dual_of_change")
        self.image, self.share = inputs.image, inputs.share
        self._image_in_space: Any = None

    def __call__(self, space: Space[Any], volume: Any, weight: float, *, nonnegative: bool) -> Any:
        if self._image_in_space is None:
            self._image_in_space = space.array(np.ascontiguousarray(self.image, np.float32))
        volume = self.plain(space, volume, (1 - self.share) * weight, nonnegative=nonnegative)
        change = space.add(volume, self._image_in_space, -1.0)
        # only the sum below must be nonnegative, not the change
        change = self.change(space, change, self.share * weight, nonnegative=False)
        return space.add(change, self._image_in_space, 1.0, nonnegative=nonnegative)


Denoiser = Callable[[np.ndarray, float], np.ndarray]
"""A user's own prior (plug-and-play): from a volume (nz, ny, nx) float32 and its noise, both in 1/mm, to a volume."""


class OwnPrior(Prior):
    """A user's denoiser, a function on the host, in place of a proximal map (plug-and-play: Venkatakrishnan et al. 2013).
    The denoiser gets small weights, and must remove less noise the smaller the weight is.

    denoiser: the function, or its ``package.module:function``. Raises InputError for what is no function."""

    def __init__(self, denoiser: str | Denoiser) -> None:
        own = imported(denoiser, "--prior") if isinstance(denoiser, str) else denoiser
        if not callable(own):
            raise InputError("--prior", checks.short_repr(own), "a function (volume, noise)")
        self.denoiser, self.subject = own, f"--prior {function_name(own)}"

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


@dataclass(frozen=True)
class PriorKind:
    """An entry of ``PRIORS``. make: builds the prior. volumes: how many more volumes than ``dct`` it holds on the device.
    subvoxel_share: weight, 0 to 1, of smaller voxels in a result; volumes too thin for ``ridge`` have ``_SUBVOXELS``."""

    make: Callable[[PriorInputs], Prior]
    volumes: int = 0
    subvoxel_share: float = _SUBVOXELS


PRIORS = {
    # the larger voxels lower noise in the result; ridge leaves less noise, so the smaller voxels get more weight
    "ridge": PriorKind(PriorInputs.dct_then_ridge, RidgeStep.VOLUMES, _SUBVOXELS_WITH_RIDGE),
    "dct": PriorKind(PriorInputs.tv_and_dct),
    "tv": PriorKind(lambda inputs: inputs.tv(_TV_ALONE)),
    "piccs": PriorKind(Piccs),
    "none": PriorKind(lambda inputs: Prior()),
}


def kind_of(prior: str | Denoiser) -> PriorKind:
    """Returns a prior's entry in ``PRIORS``; for a user's function or its name, a new entry without further volumes."""
    own = PriorKind(lambda inputs: OwnPrior(prior))
    return PRIORS.get(prior, own) if isinstance(prior, str) else own


def subvoxel_share(prior: str | Denoiser, shape: tuple[int, int, int]) -> float:
    """Returns the weight of the smaller voxels in a result, 0 to 1. shape: (nz, ny, nx) of the smaller voxels."""
    return kind_of(prior).subvoxel_share if min(shape) >= RIDGE_EDGE else _SUBVOXELS


def axis_weights(grid: Grid) -> tuple[float, float, float]:
    """Returns (finest voxel side)/(voxel side) along (z, y, x), which makes differences of voxels proportional to slopes."""
    finest = min(grid.voxel_size_mm)
    z, y, x = (finest / pitch for pitch in grid.voxel_size_mm)
    return z, y, x
