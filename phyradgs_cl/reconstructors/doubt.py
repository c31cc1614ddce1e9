"""Error bars of voxels: the method runs on the scan, and then on two more scans that are made from it.

- Iterative methods get two scans that are synthesised from the first volume and its residual. How far their volumes differ
  from the first shows the noise, other causes of the residual, and what the method does to such an object: blur, prior,
  missing views. This is a wild bootstrap (Wu, Ann. Stat. 14 (1986) 1261): each frame's residual keeps its size and shape,
  but gets a random sign. The second synthesised scan has the opposite signs (antithetic variables).
- Analytic methods get every second view, and then the other views. Half the difference of both volumes has the noise of the
  whole scan's volume, and the streaks that missing views cause. FDK's volume of a synthesised scan would have the same
  streaks as the first, so that the difference would not show them.

Factors turn these differences into σ. They were fitted to procedural volumes (benchmarks/doubt.py), and are corrected at
held-out pixels if there are any."""

import json
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from phyradgs_cl import resource
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.altered.angles import azimuth_rad, middle_poses
from phyradgs_cl.acquisition.altered.coarse import some_frames
from phyradgs_cl.detector.noise_level import noise_map
from phyradgs_cl.fields import Deformation, Gaussians, Grid, States
from phyradgs_cl.metrics.coverage import object_voxels
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.fdk.arc import distinct_views, view_arc
from phyradgs_cl.reconstructors.fdk.travel import travels
from phyradgs_cl.reconstructors.projected import FRAMES_AT_A_TIME, FramePair, frame_pairs, spread_frames
from phyradgs_cl.reconstructors.result import DOUBT, Progress, ProgressReport, Reconstruction, through
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.text import without_warnings

# Methods whose error bars were checked against true volumes. The laws of ``fitted_law`` come from runs of the first 3.
MEASURED = ("fista", "fista-tv", "fdk", "phyradgs", "asd-pocs", "cgls", "os-sart", "sart", "sirt")
RUNS = 3  # number of runs of the method: on the scan, and on two scans that are made from it
PARTS = 2  # a voxel's side is divided into this many parts before projection, because projecting large voxels blurs
FEWEST_FRAMES = 4  # analytic methods need this many frames: with one in each half, bars were 3 times too narrow
_EDGE = 0.8  # standard deviation, in voxels, of the Gaussian whose derivative gives the slope of edges
_DENSEST = 3.0  # a voxel's density counts as at most this many times the object's mean density
LEAST = 0.01  # least error bar σ of a voxel, as a fraction of the RMS of σ over the volume
# Filter along one axis, which gives (slope per voxel)/4 of the spline whose mean over each voxel is the voxel's value.
_SLOPES = (0.00387, -0.01443, 0.05385, -0.20096, 0, 0.20096, -0.05385, 0.01443, -0.00387)
_KEPT = "doubt."  # prefix of the names of those arrays in a state that belong to complete runs
_PARTS = {"gaussians": Gaussians, "deformation": Deformation, "states": States}
_CHECKED_FRAMES = 16  # number of frames whose held-out pixels correct σ
_AROUND = 9  # a pixel's squared error bar is averaged over a square of so many pixels a side: two runs give a rough bar
# A residual above this many times the noise causes a warning; simulations had at most 1.2. So do errors of held-out pixels
# above this many times the error bars.
_UNEXPLAINED = 2.0
_UNSEEN_RAD = 0.05  # more of half a turn without views causes a warning of analytic methods: both halves lack the same views
# A larger quotient noise/(line integrals) causes a warning: at 0.05 to 0.06, σ held 43 to 59 % of errors, not 68 %.
_NOISY = 0.03
_WIDEST = 4.0  # σ is multiplied by at most this factor: still larger errors of held-out pixels have other causes
# (Number of views)/(voxels along a slice's longer side) for which a law was fitted: here its factor is 1.
_USUAL_VIEWS = 25 / 64
_FEWEST_VIEWS = 0.1  # least value of that quotient in a law's factor: no law was measured with fewer views
_SHARE, _NORMAL_95 = 0.68, 1.96  # fraction of errors within σ; standard deviations that hold 95 % of normal noise
Array = NDArray[Any]
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Law:
    """Fitted factors of the four parts of σ whose squares ``spread`` adds: shape, noise, density, slope. near: standard
    deviation of its smoothing in voxels. multiple_95: (95 % bar)/σ. sparse, dense: how σ
    grows with fewer and falls with more views (``factor``)."""

    shape: float
    noise: float
    density: float
    slope: float
    near: float
    multiple_95: float
    sparse: float = 0.0
    dense: float = 0.0

    def factor(self, views: int, grid: Grid) -> float:
        """Returns σ from ``views`` views on ``grid``, over σ from the usual number. All runs of a scan lack the same views,
        so that differences between runs show too little of the errors that missing views cause."""
        missing = _USUAL_VIEWS / max(views / max(grid.shape[1:]), _FEWEST_VIEWS)
        return 1 + self.sparse * (missing - 1) if missing > 1 else missing**self.dense

    def for_views(self, views: int, grid: Grid) -> "Law":
        """Returns the law with shape, noise and slope times ``factor``. ``density`` stays: it multiplies the others' sum."""
        factor = self.factor(views, grid)
        return replace(self, shape=factor * self.shape, noise=factor * self.noise, slope=factor * self.slope)


def fitted_law(kind: str) -> Law:
    """Returns the law of ``iterative`` or ``analytic`` methods, from ``data/doubt.json`` (benchmarks/doubt.py)."""
    return Law(**json.loads((resource("data") / "doubt.json").read_text(encoding="utf-8"))[kind]["law"])


def spread(first: Array, second: Array, third: Array, law: Law) -> Array:
    """Returns the error bar σ (nz, ny, nx) of the first of three volumes, or of the first of three images.

    (second + third)/2 − first is what the method does to the object. (second − third)/2 is noise, which has opposite signs
    in the two. The squares of both, smoothed over ``near`` voxels, are weighted by ``shape``² and ``noise``². Dense matter
    may have texture that all three lack: it gets ``density``² of the object's mean variance, in proportion to its density.
    Edges may be blurred in all three: they get ``slope``² times the squared change of density per voxel. σ is at least a
    hundredth of its RMS over the volume."""
    one, two = (other.astype(np.float64) - first for other in (second, third))
    shape, noise = (scipy.ndimage.gaussian_filter(part**2 / 4, law.near) for part in (one + two, one - two))
    variance = law.shape**2 * shape + law.noise**2 * noise
    if law.slope:
        variance += (law.slope * scipy.ndimage.gaussian_gradient_magnitude(first.astype(np.float64), _EDGE)) ** 2
    if law.density and (inside := object_voxels(first)).any():
        density = np.maximum(scipy.ndimage.gaussian_filter(first, 1.0), 0)
        times = np.minimum(density / density[inside].mean(), _DENSEST)
        variance += law.density**2 * np.mean(variance[inside]) * times
    return np.sqrt(np.maximum(variance, LEAST**2 * np.mean(variance))).astype(np.float32)


def finer(volume: Array) -> NDArray[np.float32]:
    """Returns a volume (nz, ny, nx) on voxels of half the side. The mean of the eight parts of a voxel is the voxel's value.

    Along an axis, both halves of a voxel are means of a spline whose mean over the voxel is its value (histospline)."""
    for axis in range(3):
        half = scipy.ndimage.correlate1d(volume, _SLOPES, axis, mode="nearest")
        halves = np.stack([volume - half, volume + half], axis + 1)
        volume = halves.reshape(*volume.shape[:axis], -1, *volume.shape[axis + 1 :])
    return volume.astype(np.float32)


def view_numbers(scan: Scan) -> Array:
    """Returns the number (F,) of each frame's view, from 0 in the order of angles; frames of one angle are one view.

    Each frame is a view of its own, in the order of time, if there are fewer than 4 angles, or if the orbit travels along
    the axis, since each turn then sees another height."""
    pose = middle_poses(scan)
    view, angles_rad = distinct_views(azimuth_rad(pose))
    if len(angles_rad) < FEWEST_FRAMES or travels(pose, scan.projections.shape[1], scan.is_parallel):
        return np.arange(scan.frames)
    return view


def halves(scan: Scan) -> tuple[Array, Array]:
    """Returns the frame numbers of both halves of a scan: every second view of ``view_numbers``, and the others.

    Frames of one angle go to the same half: if both halves had this angle, their streaks would not differ."""
    view = view_numbers(scan)
    return np.flatnonzero(view % 2 == 0), np.flatnonzero(view % 2 == 1)


@dataclass(frozen=True, eq=False)
class Doubter:
    """Runs a method three times, and computes error bars from the results. scan: the scan without its held-out pixels.
    whole: the scan with them. hidden: bool (F, rows, columns), True at held-out pixels; None: there are none. deformation:
    how the object moves. seed: draws the signs of residuals. kind: ``iterative`` or ``analytic``, as in ``fitted_law``."""

    rt: Runtime
    scan: Scan
    whole: Scan
    hidden: NDArray[np.bool_] | None
    deformation: Deformation | None
    seed: int
    kind: str = "iterative"

    def run(self, once: Callable[..., Reconstruction], report: ProgressReport, resume: State | None) -> Reconstruction:
        """Returns the method's result with ``doubt``, or a partial result after an interruption. once: runs the method on a
        scan, from a state or, with None, from the start, with a report. resume: the state of an interrupted ``run``."""
        arrays = dict(resume or {})
        results = _restored({name: arrays.pop(name) for name in list(arrays) if name.startswith(_KEPT)}, self.scan.grid)
        while len(results) < RUNS:
            scan = self.scan_of_run(results[0], len(results)) if results else self.scan
            half = without_warnings() if results and self.kind == "analytic" else nullcontext()  # FDK warns of half scans
            with half:
                result = once(scan, arrays or None, through(partial(_counted, results=results), report))
            if result.state is not None:
                return _interrupted(result, results)
            results, arrays = [*results, result], {}
        return self.finished(results)

    def scan_of_run(self, result: Reconstruction, number: int) -> Scan:
        """Returns the scan for run ``number``, 1 or 2: half of the frames for an analytic method, else a synthesised scan.

        A synthesised frame is ``result``'s projection, plus its residual with a random sign, which is opposite in run 2."""
        if self.kind == "analytic":
            return some_frames(self.scan, halves(self.scan)[number - 1])
        frames, sums = np.zeros(self.scan.projections.shape, np.float32), np.zeros(5)
        if self.rt.ranks.rank == 0:
            for pair in self._pairs(result, self.whole.frames):
                sign = np.random.default_rng([self.seed, pair.frame]).choice((-1, 1)) * (1 if number == 1 else -1)
                synthesised = pair.computed + sign * pair.residual
                frames[pair.frame] = np.where(pair.valid, synthesised, self.scan.projections[pair.frame])
                if number == 1:
                    rms = noise_map(pair.residual, pair.valid)
                    images = (pair.residual**2, rms**2, pair.measured**2, np.abs(pair.measured), pair.valid)
                    sums += [np.sum(one[pair.valid], dtype=np.float64) for one in images]
            if sums.all():
                advice = "" if self.hidden is not None else "give --holdout 2, and "
                _warn_of(sums[:4] / sums[4], advice)
        return replace(self.scan, projections=self.rt.ranks.bcast(frames))

    def _pairs(self, result: Reconstruction, count: int) -> Iterator[FramePair]:
        """Yields ``count`` evenly spread measured frames, each with the frame computed from the result's volume on voxels of
        half the side (``finer``)."""
        chosen, moves = spread_frames(self.whole.frames, count), result.moves or self.deformation
        volume, grid = finer(result.volume), result.grid.finer(PARTS)
        if isinstance(moves, States):
            moves = replace(moves, volumes=np.stack([finer(state) for state in moves.volumes]))
        for at in range(0, len(chosen), FRAMES_AT_A_TIME):
            yield from frame_pairs(self.rt, self.whole, volume, grid, chosen[at : at + FRAMES_AT_A_TIME], moves)

    def finished(self, results: list[Reconstruction]) -> Reconstruction:
        """Returns the first run's result with σ, facts about σ and the seconds of all runs; unchanged if all runs agree."""
        views, first = int(view_numbers(self.scan).max()) + 1, results[0]  # repeated frames show no further view
        law = fitted_law(self.kind).for_views(views, self.scan.grid)
        if all(np.array_equal(first.volume, other.volume) for other in results[1:]):
            log.warning("all three runs have the same volume: there are no error bars; give the method more iterations")
            return first
        sigma = spread(first.volume, results[1].volume, results[2].volume, law)
        if self.kind == "analytic":
            unseen_rad = view_arc(azimuth_rad(middle_poses(self.scan))).unseen_rad()
            if unseen_rad > _UNSEEN_RAD:
                text = "error bars do not hold the errors that %.3g° of half a turn without views cause: take --method fista"
                log.warning(text, np.rad2deg(unseen_rad))
        if self.scan.metal is not None:
            log.warning("error bars do not hold in metal, whose voxels come from a first volume")
        facts: dict[str, Any] = {"runs": RUNS, "share": _SHARE, "multiple_95": law.multiple_95}
        if self.hidden is not None and self.rt.ranks.size == 1:
            facts |= self._against_held_out(results, self.hidden, law)
            sigma *= np.float32(facts["held_out_factor"])
        # the mean bar is weighted by density, so that noise and streaks in air do not count
        total = float(first.volume.sum(dtype=np.float64))
        weighted = np.sum(sigma * first.volume, dtype=np.float64) / total if total > 0 else sigma.mean()
        facts["mean_per_mm"] = float(weighted)
        facts = {DOUBT: facts, "seconds": sum(float(one.facts["seconds"]) for one in results)}
        return replace(first, doubt=sigma, facts={**first.facts, **facts})

    def _against_held_out(self, results: list[Reconstruction], hidden: NDArray[np.bool_], law: Law) -> dict[str, float]:
        """Returns the fractions of held-out pixels whose errors are within σ and within the 95 % bar, and the factor of σ,
        from 1 to 4, by ``widening``. A pixel's σ combines its noise with the ``spread`` of the projections around it."""
        pixels, inside = [], []
        for first, one, two in zip(*(self._pairs(result, _CHECKED_FRAMES) for result in results), strict=True):
            held = hidden[first.frame]
            noise, error = noise_map(first.residual, first.valid)[held], first.residual[held]
            bar = spread(first.computed, one.computed, two.computed, law).astype(np.float64)
            bar = np.sqrt(scipy.ndimage.uniform_filter(bar**2, _AROUND))[held]
            pixels.append([error, noise, bar])
            wide = np.hypot(_NORMAL_95 * noise, law.multiple_95 * bar)
            inside.append([np.abs(error) <= np.hypot(noise, bar), np.abs(error) <= wide])
        wanted = widening(*np.concatenate(pixels, axis=1))
        if wanted > _UNEXPLAINED:
            text = "held-out pixels are %.3g times farther off than the error bars, which are widened by %.3g and hold the "
            text += "cause in part: run 'phyradgs check', and take a box around the whole object"
            log.warning(text, wanted, min(wanted, _WIDEST))
        within, within_95 = np.mean(np.concatenate(inside, axis=1), axis=1).tolist()
        return {"held_out_within": within, "held_out_within_95": within_95, "held_out_factor": min(wanted, _WIDEST)}


def widening(errors: Array, noise: Array, bars: Array) -> float:
    """Returns the factor k ≥ 1 of ``bars`` (n,) with which 68 % of the errors (n,) have |error| ≤ √(noise² + k² bar²). The
    fraction may lie two of its standard errors below 68 %, because chance alone would otherwise widen bars that are far
    below the noise."""
    share = _SHARE - 2 * np.sqrt(_SHARE * (1 - _SHARE) / len(errors))
    ratios = (errors**2 - noise**2) / np.maximum(bars, 1e-30) ** 2
    return float(np.sqrt(max(np.quantile(ratios, max(share, 0.0)), 1.0)))


def _warn_of(means: Array, first_advice: str) -> None:
    """Warns if error bars may be too narrow. means: over the valid pixels, of residual², noise², (line integral)² and |line
    integral|. first_advice: comes before the usual advice."""
    residual_square, noise_square, square, mean = means.tolist()
    unexplained, noisy = (residual_square / noise_square) ** 0.5, noise_square**0.5 / (square / mean)
    if unexplained > _UNEXPLAINED:
        text = "the volume leaves %.3g times the noise of the projections unexplained: error bars hold what causes that in "
        text += "part, and may be too narrow; %srun 'phyradgs check'"
        log.warning(text, unexplained, first_advice)
    if noisy > _NOISY:
        text = "the noise is %.2g %% of the object's line integrals: error bars do not hold soft texture that it hides"
        log.warning(text, 100 * noisy)


def _counted(progress: Progress, results: list[Reconstruction]) -> Progress:
    """Returns progress that counts the iterations of all runs together. It always shows the volume of the first run."""
    done, each = progress.iteration + len(results) * progress.iterations, RUNS * progress.iterations
    progress = progress.mapped(state=lambda state: {**state, **_kept(results)}, iteration=done, iterations=each)
    if not results:
        return progress
    first, words = results[0], f"{progress.quantity} of run {len(results) + 1} for error bars"
    states = None if (of_first := first.states) is None else lambda: of_first
    shown = {"volume": lambda: (first.volume, first.grid), "deformation": first.deformation, "states": states}
    return replace(progress, quantity=words, **shown)  # type: ignore[arg-type]


def _interrupted(result: Reconstruction, results: list[Reconstruction]) -> Reconstruction:
    """Returns the first run's result, with all that --resume needs: the state of the interrupted run ``result`` and the
    complete runs before it."""
    first, run = (*results, result)[0], {"interrupted_in_run": f"{len(results) + 1} of {RUNS}"}
    facts = {**first.facts, "interrupted_at": result.facts["interrupted_at"], DOUBT: run}
    return replace(first, state={**(result.state or {}), **_kept(results)}, facts=facts)


def _kept(results: list[Reconstruction]) -> State:
    """Returns the arrays by which a state keeps complete runs: all parts of the first, volume and seconds of the others."""
    if not results:
        return {}
    first, seconds = results[0], [one.facts["seconds"] for one in results]
    notes = json.dumps({"facts": first.facts, "record": first.record, "seconds": seconds}, default=str)
    arrays = {"notes": np.array(notes), "volumes": np.stack([one.volume for one in results])}
    parts = {name: part for name in _PARTS if (part := getattr(first, name)) is not None}
    arrays |= {f"{name}.{key}": np.asarray(value) for name, part in parts.items() for key, value in vars(part).items()}
    return {_KEPT + name: values for name, values in arrays.items()}


def _restored(kept: Mapping[str, np.ndarray], grid: Grid) -> list[Reconstruction]:
    """Returns the complete runs that ``_kept`` has put into a state, on ``grid``; an empty list if the state holds none."""
    if not kept:
        return []
    arrays = {name.removeprefix(_KEPT): values for name, values in kept.items()}
    notes, parts = json.loads(str(arrays["notes"])), dict[str, Any]()
    for name, kind in _PARTS.items():
        if of_part := {key: a for one, a in arrays.items() if (key := one.removeprefix(f"{name}.")) != one}:
            parts[name] = kind(**of_part)
    first, *others = arrays["volumes"]
    later = [Reconstruction(v, grid, facts={"seconds": s}) for v, s in zip(others, notes["seconds"][1:], strict=True)]
    return [Reconstruction(first, grid, record=notes["record"], facts=notes["facts"], **parts), *later]
