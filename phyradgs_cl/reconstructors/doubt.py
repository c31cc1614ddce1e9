"""Error bars of voxels: the run is repeated on two scans that are synthesised from its own volume, with this scan's noise.

The differences of their volumes from the first hold the noise of the scan, and what the method does to such an object: blur,
prior, missing views. That is a parametric bootstrap (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, ch. 6).
Numbers that make it a σ come from procedural volumes (benchmarks/doubt.py), and from held-out pixels where there are any."""

import json
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from phyradgs_cl import resource
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.detector.noise_level import noise_map
from phyradgs_cl.fields import Deformation, Gaussians, Grid, States
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.projected import FRAMES_AT_A_TIME, FramePair, frame_pairs, spread_frames
from phyradgs_cl.reconstructors.result import DOUBT, Progress, Reconstruction, Report
from phyradgs_cl.runtime import Runtime

RUNS = 3
"""Runs of the method: that of the scan, and two of synthesised scans."""
_KEPT = "doubt."  # begins the names of what a state keeps of the runs before
_PARTS = {"gaussians": Gaussians, "deformation": Deformation, "states": States}
_CHECKED_FRAMES = 16  # frames whose held-out pixels correct σ
_WIDEST = 4.0  # times: held-out pixels farther off are no matter of error bars
_SHARE = 0.68  # of the object's voxels within σ
_NEAR, _WIDE = 1.0, 3.0  # voxels: standard deviations of the Gaussians that smooth squares of differences
Array = NDArray[np.floating]
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Law:
    """Numbers of ``spread``, from ``data/doubt.json``. multiple_95: how many times σ the 95 % bar is."""

    shape: float
    noise: float
    wide: float
    floor: float
    multiple_95: float


@cache
def fitted_law() -> Law:
    """Returns the numbers that ``benchmarks/doubt.py fit`` has written."""
    stored = json.loads((resource("data") / "doubt.json").read_text(encoding="utf-8"))
    return Law(**{one.name: float(stored[one.name]) for one in fields(Law)})


def spread(first: Array, second: Array, law: Law) -> Array:
    """Returns σ (nz, ny, nx) of two differences from the first volume (nz, ny, nx).

    What both have in common is what the method does to the object; half of what they have not is noise. Their variances are
    weighed by ``shape`` and ``noise``, and smoothed over 1 voxel, with the share ``wide`` over 3. ``floor``: of their mean."""
    common, own = ((first + sign * second).astype(np.float64) ** 2 / 4 for sign in (1, -1))
    both = [law.shape**2 * (common - own), 2 * law.noise**2 * own]  # half of the noise is left in what is common
    variance = sum(
        np.maximum(share * scipy.ndimage.gaussian_filter(part, width), 0)
        for part in both for width, share in ((_NEAR, 1 - law.wide), (_WIDE, law.wide))
    )  # fmt: skip
    return np.sqrt(variance + law.floor**2 * np.mean(variance)).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Doubter:
    """The runs of a method. scan: as the method sees it; whole: with its held-out pixels ``hidden`` (F, v, u)."""

    rt: Runtime
    scan: Scan
    whole: Scan
    hidden: NDArray[np.bool_] | None
    deformation: Deformation | None
    seed: int

    def run(self, once: Callable[..., Reconstruction], report: Report, resume: State | None) -> Reconstruction:
        """Returns the method's result with its ``doubt``. once: runs the method on a scan, from a state of its own.

        resume: the state of any of the runs."""
        arrays = dict(resume or {})
        kept = {name: arrays.pop(name) for name in list(arrays) if name.startswith(_KEPT)}
        results = _restored(kept, self.scan.grid) if kept else []
        while len(results) < RUNS:
            number, before = len(results), _kept(results)
            scan = self.synthesised(results[0], number) if results else self.scan
            with report.through(partial(_counted, number=number, before=before, first=results[0] if results else None)):
                result = once(scan, arrays or None)
            if result.state is not None:
                return _interrupted(result, results, before)
            results.append(result)
            arrays = {}
        return self.finished(results)

    def synthesised(self, result: Reconstruction, number: int) -> Scan:
        """Returns the scan that the result's volume would give, with the noise of this one. ``number`` draws it."""
        frames = np.zeros(self.scan.projections.shape, np.float32)
        if self.rt.ranks.rank == 0:
            for pair in self._pairs(result):
                rng = np.random.default_rng([self.seed, number, pair.frame])
                noise = noise_map(pair.residual, pair.valid) * rng.standard_normal(pair.measured.shape, np.float32)
                frames[pair.frame] = np.where(pair.valid, pair.computed + noise, self.scan.projections[pair.frame])
        return replace(self.scan, projections=self.rt.ranks.bcast(frames))

    def _pairs(self, result: Reconstruction, count: int | None = None) -> Iterator[FramePair]:
        """Yields all frames, or ``count`` of them, with those of a result."""
        frames, moves = self.whole.frames, result.moves or self.deformation
        chosen = spread_frames(frames, frames if count is None else count)
        for at in range(0, len(chosen), FRAMES_AT_A_TIME):
            some = chosen[at : at + FRAMES_AT_A_TIME]
            yield from frame_pairs(self.rt, self.whole, result.volume, result.grid, some, moves)

    def finished(self, results: list[Reconstruction]) -> Reconstruction:
        """Returns the first result with σ, its facts, and the seconds of all runs."""
        first, *others = results
        law, differences = fitted_law(), [other.volume - first.volume for other in others]
        sigma = spread(*differences, law)
        facts: dict[str, object] = {"runs": RUNS, "share": _SHARE, "multiple_95": law.multiple_95, "held_out_factor": 1.0}
        if self.hidden is not None and self.rt.ranks.size == 1:
            facts |= self._against_held_out(results, law)
            sigma *= np.float32(facts["held_out_factor"])
        seconds = sum(float(one.facts["seconds"]) for one in results)
        return replace(first, doubt=sigma, facts={**first.facts, DOUBT: facts, "seconds": seconds})

    def _against_held_out(self, results: list[Reconstruction], law: Law) -> dict[str, object]:
        """Returns the factor by which σ must grow so that 68 % of the held-out pixels are within what it means for them.

        At a pixel that is the projected differences, by the same law, and the pixel's noise."""
        assert self.hidden is not None
        ratios, inside = [], []
        for pairs in zip(*(self._pairs(one, _CHECKED_FRAMES) for one in results), strict=True):
            first, *others = pairs
            held = self.hidden[first.frame]
            noise = noise_map(first.residual, first.valid)[held]
            bar = spread(*(other.computed - first.computed for other in others), law)[held]
            error = np.abs(first.residual[held])
            ratios.append((error**2 - noise**2) / np.maximum(bar, 1e-30) ** 2)
            inside.append([error <= k * np.hypot(noise, bar) for k in (1.0, law.multiple_95)])
        wanted = float(np.sqrt(max(np.quantile(np.concatenate(ratios), _SHARE), 1.0)))
        if wanted > _WIDEST:
            text = "held-out pixels are %.3g times farther off than the error bars say: geometry, beam or motion are wrong; "
            log.warning(text + "the error bars are %g times wider, and may not suffice: run 'phyradgs check'", wanted, _WIDEST)
        shares = np.mean(np.concatenate(inside, axis=1), axis=1).tolist()
        return {"held_out_factor": min(wanted, _WIDEST), "held_out_within": shares[0], "held_out_within_95": shares[1]}


def _counted(progress: Progress, number: int, before: State, first: Reconstruction | None) -> Progress:
    """Counts the iterations of all runs as those of one, and shows the volume of the first while the others run."""
    changes: dict[str, Any] = {}
    if first is not None:
        changes = {"volume": lambda: (first.volume, first.grid), "deformation": first.deformation}
        changes["states"] = None if (states := first.states) is None else lambda: states
        changes["quantity"] = f"{progress.quantity} of run {number + 1} for error bars"
    done, each = progress.iteration, progress.iterations
    counted = replace(progress, **changes, iteration=number * each + done, iterations=RUNS * each)
    return counted.mapped(state=lambda state: {**state, **before})


def _interrupted(result: Reconstruction, results: list[Reconstruction], before: State) -> Reconstruction:
    """Returns the first volume, which is whole, with the state of a later run. Of the first run the result itself."""
    if not results or result.state is None:
        return result
    first, run = results[0], f"{len(results) + 1} of {RUNS}"
    facts = {**first.facts, "interrupted_at": result.facts["interrupted_at"], DOUBT: {"interrupted_in_run": run}}
    return replace(first, state={**result.state, **before}, facts=facts)


def _kept(results: list[Reconstruction]) -> State:
    """Returns what a state keeps of complete runs: all of the first, the volumes and seconds of others."""
    if not results:
        return {}
    first = results[0]
    notes = {"facts": first.facts, "record": first.record, "seconds": [one.facts["seconds"] for one in results]}
    arrays = {"notes": np.array(json.dumps(notes)), "volumes": np.stack([one.volume for one in results])}
    for name in _PARTS:
        if (part := getattr(first, name)) is not None:
            arrays |= {f"{name}.{key}": np.asarray(value) for key, value in vars(part).items()}
    return {_KEPT + name: values for name, values in arrays.items()}


def _restored(kept: Mapping[str, np.ndarray], grid: Grid) -> list[Reconstruction]:
    """Returns the complete runs that ``_kept`` has put into a state."""
    arrays = {name.removeprefix(_KEPT): values for name, values in kept.items()}
    notes = json.loads(str(arrays["notes"]))
    parts = {
        name: kind(**{one.name: arrays[f"{name}.{one.name}"] for one in fields(kind)})
        for name, kind in _PARTS.items() if any(key.startswith(f"{name}.") for key in arrays)
    }  # fmt: skip
    first, *others = arrays["volumes"]
    later = [Reconstruction(v, grid, facts={"seconds": s}) for v, s in zip(others, notes["seconds"][1:], strict=True)]
    return [Reconstruction(first, grid, record=notes["record"], facts=notes["facts"], **parts), *later]
