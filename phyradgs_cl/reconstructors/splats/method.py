"""The splatting methods ``phyradgs`` and ``r2``: radiative Gaussians that are optimised against a scan's frames.

phyradgs is the paper's method, exact splats that follow the gantry's motion; with a static motion it is the paper's "w/o
ST". r2 is R2-Gaussian (Zha et al. 2024): affine splats with its published constants. With micro-views r2 is the paper's "R2
w/ ST".

Internally, lengths are divided by half the volume's longest side and densities by a reference (FDK's 99.9th percentile), so
that learning rates, thresholds and SSIM's constants hold for every scan."""

import json
import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Exact, Motion, Scan
from phyradgs_cl.acquisition.motion import motion_facts
from phyradgs_cl.checks import ceil_div
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Gaussians, Grid
from phyradgs_cl.fields.gaussians import SCALE
from phyradgs_cl.operators import voxelise
from phyradgs_cl.optim import Population, control_density
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.loop import Loop
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, ignore_progress, option_facts
from phyradgs_cl.reconstructors.splats.options import PRESETS, R2_PUBLISHED, SplatOptions
from phyradgs_cl.reconstructors.splats.start import first_population, internal_scale
from phyradgs_cl.reconstructors.splats.step import Batch, DeviceCloud, FrameStep, Scale
from phyradgs_cl.runtime import Runtime

REPORT_EVERY = 50  # iterations between progress reports; lines of the convergence record are as far apart or closer
LEAST_RECORDED = 20  # short runs record more often, so that a run of at least this many iterations has this many lines


class SplatRun:
    """The running state of a splatting method, the same on every rank (MPI process). A ``Loop`` runs it step by step."""

    quantity, remedy, finished = "loss", "check the scan for extreme values", None

    def __init__(
        self, rt: Runtime, scan: Scan, options: SplatOptions, scale: Scale, population: Population,
        rng: np.random.Generator, deformation: Deformation | None = None,
    ) -> None:
        self.rt, self.options, self.scale, self.rng = rt, options, scale, rng
        self.grid = scan.grid.scaled(1 / scale.length_mm)
        self.activation = options.activation(self.grid)
        self._take(options.batch_for(scan.frames, rt.ranks.size))
        self.frame_step = FrameStep(rt, scan, options, scale, self.grid, deformation)
        self.frames, self.adam = self.frame_step.frames, self.frame_step.adam
        self.iteration, self.iterations = 0, options.iterations
        self.control_seconds, self.control_rounds = 0.0, 0
        self._queue: list[int] = []
        self.cloud = DeviceCloud(rt, population)

    def _take(self, batch: int) -> None:
        """Sets the number of frames of a step. Raises InputError if a rank has no frame of them."""
        self.batch, ranks = batch, self.rt.ranks.size
        if ranks > batch:
            found, remedy = f"{batch} for {ranks} ranks", "raise it, or take fewer ranks"
            raise InputError("batch", found, "a frame for every rank", remedy)

    def step(self) -> None:
        """Takes a step of Adam down the gradient of one batch of frames, then controls density if it is due."""
        options, before = self.options, self.iteration
        self.frame_step.follow(self.motion_at(before))
        batch = self.next_batch()
        cloud, stride = self.cloud, self.cloud.gaussians.stride
        self.adam.activate(cloud.raw, cloud.gaussians.rows, cloud.count, stride)
        if self.batch == 1:
            self.frame_step.gradient(cloud, batch.frames[0], batch.corners[0], batch.late, cloud.statistics)
        else:
            self.frame_step.differentiate(cloud, batch)
        rates = options.rates.at(before / max(options.iterations, 1)) * np.sqrt(len(batch.frames))
        self.iteration += len(batch.frames)
        self.adam.step(cloud.raw, cloud.gradients, cloud.moments, stride, rates, ceil_div(self.iteration, self.batch))
        del cloud  # density control frees the arrays
        passed = range(before + 1, self.iteration + 1)
        if any(options.control.is_due(iteration, options.iterations) for iteration in passed):
            self.control_density()

    def motion_at(self, iteration: int) -> Motion:
        """Returns the motion model of an iteration: coarse in early iterations, if the object of a fly-scan is at rest."""
        is_coarse = self.frames.scan.is_fly and self.frames.deformation is None
        return self.options.motion_at(iteration / max(self.iterations, 1)) if is_coarse else self.options.motion

    def phases(self) -> list[dict[str, object]]:
        """Returns the motion models of the run, each with its first iteration."""
        found: list[dict[str, object]] = []
        for iteration in range(self.iterations):
            facts = motion_facts(self.motion_at(iteration))
            if not found or found[-1]["motion"] != facts:
                found.append({"from": iteration, "motion": facts})
        return found

    def next_batch(self) -> Batch:
        """Draws the frames of the next step: all frames follow in random order, before any of them is drawn again."""
        frames = []
        for _ in range(min(self.batch, max(self.iterations - self.iteration, 1))):
            if not self._queue:
                self._queue = self.rng.permutation(self.frames.count).tolist()
            frames.append(self._queue.pop())
        corners = [self.frame_step.draw_corner(self.rng) for _ in frames]
        return Batch(frames, corners, late=self.iteration >= self.options.parameter_terms_from)

    def measures(self) -> dict[str, float]:
        return {"loss": self.frame_step.mean_loss(), "gaussians": self.cloud.count}

    def control_density(self) -> None:
        sums = self.cloud.read_statistics().astype(np.float64)
        begun = time.perf_counter()  # after the download, which waits for the device: only density control is timed
        statistic = sums[0] / np.maximum(sums[1], 1)
        population, box = self.cloud.population(), self.grid.box_mm[::-1].T
        self._load(control_density(population, statistic, self.activation, self.options.control, box, self.rng))
        self.control_seconds += time.perf_counter() - begun
        self.control_rounds += 1

    def _load(self, population: Population) -> None:
        del self.cloud  # a device may have no room for the old and the new arrays together
        self.cloud = DeviceCloud(self.rt, population)

    def state(self) -> dict[str, np.ndarray]:
        population = self.cloud.population()
        return {
            "raw": population.raw, "moments": population.moments, "statistics": self.cloud.read_statistics(),
            "iteration": np.array(self.iteration), "batch": np.array(self.batch),
            "queue": np.array(self._queue, np.int64),
            "rng": np.array(json.dumps(self.rng.bit_generator.state)),
        }  # fmt: skip

    def restore(self, state: State) -> None:
        """Continues from ``state``. Raises InputError for more ranks than a batch has frames."""
        self.iteration = int(state["iteration"])
        self._take(int(state["batch"]))
        self.rng.bit_generator.state = json.loads(str(state["rng"]))
        self._load(Population(state["raw"], state["moments"]))
        self.cloud.write_statistics(state["statistics"])
        self._queue = state["queue"].tolist()

    def present_cloud(self) -> Gaussians:
        """Returns the Gaussians in internal units, without those too thin for density control (``prune_aspect``)."""
        rows = self.activation.apply(self.cloud.population().raw.astype(np.float64))
        return Gaussians.from_rows(rows[:, self.options.control.allows(rows[SCALE])])

    def present_volume(self) -> tuple[np.ndarray, Grid]:
        """Returns ``present_cloud`` as a volume (nz, ny, nx) in 1/mm, on the scan's grid in mm."""
        cloud = self.present_cloud()
        volume = voxelise(self.rt, cloud.rows(), self.grid, cutoff_sigma=self.options.cutoff_sigma)
        return volume * np.float32(self.scale.density_per_mm), self.grid.scaled(self.scale.length_mm)


def reconstruct_splats(
    scan: Scan, options: SplatOptions, rt: Runtime, *, method: str, seed: int = 0,
    report: ProgressReport = ignore_progress, resume: State | None = None, initial: np.ndarray | None = None,
    deformation: Deformation | None = None,
) -> Reconstruction:
    """Runs a splatting method and returns its result. method: its name in the facts, ``phyradgs`` or ``r2``.

    resume: continues an interrupted run of the same scan and options from its state. initial: the volume (nz, ny, nx) in
    1/mm from which the Gaussians are drawn; None: an FDK volume. deformation: how the object moves; Gaussians and volume
    then show its reference state."""
    started = time.perf_counter()
    if deformation is not None and deformation.is_still:
        deformation = None
    # rank 0 makes the first Gaussians and sends them to the other ranks
    of_reference = (rt, scan, options, seed, initial, deformation)
    scale, population, rng = rt.ranks.bcast(first_cloud(*of_reference) if rt.ranks.rank == 0 else None)
    first_count = population.count
    run = SplatRun(rt, scan, options, scale, population, rng, deformation)
    record_every = max(1, min(REPORT_EVERY, options.iterations // LEAST_RECORDED))
    loop = Loop(run, rt.ranks, report, started, record_every, REPORT_EVERY)
    loop.run(resume)
    cloud = run.present_cloud()
    volume = run.present_volume()[0]
    facts = {
        "method": method, "options": option_facts(options), "seed": seed, "unit_length_mm": scale.length_mm,
        "unit_density_per_mm": scale.density_per_mm, "gaussians_asked": options.gaussians_for(run.grid),
        "gaussians_first": first_count, "gaussians": cloud.count, "seconds": loop.seconds,
        "density_control_seconds": run.control_seconds, "density_control_rounds": run.control_rounds,
        "interrupted_at": loop.interrupted_at,
        "detector_model": "log" if run.frames.intensity_unit is None else "intensity", "batch": run.batch,
        "ranks": rt.ranks.size,
    }  # fmt: skip
    if isinstance(options.motion, Exact):
        # frames may have different numbers of segments: the largest number is stated
        facts |= {"segments": max(cells.count for cells in run.frames.cells), "motion_phases": run.phases()}
    cloud = cloud.scaled(scale.length_mm, scale.density_per_mm)
    return Reconstruction(volume, scan.grid, cloud, loop.record, facts, loop.state_if_interrupted())


def first_cloud(
    rt: Runtime, scan: Scan, options: SplatOptions, seed: int, initial: np.ndarray | None = None,
    deformation: Deformation | None = None,
) -> tuple[Scale, Population, np.random.Generator]:
    """Returns the internal units, the first Gaussians, and the random generator that drew them. The Gaussians are drawn from
    the volume ``initial`` (nz, ny, nx) in 1/mm; if that is None, from FDK's volume."""
    first = static_fdk(rt, scan, deformation) if initial is None else initial
    scale = internal_scale(first, scan.grid)
    rng = np.random.default_rng(seed)
    grid = scan.grid.scaled(1 / scale.length_mm)
    return scale, first_population(first / scale.density_per_mm, grid, options, rng), rng


def _r2(scan: Scan, options: SplatOptions, rt: Runtime, **arguments: Any) -> Reconstruction:
    return reconstruct_splats(scan, replace(options, affine=True), rt, method="r2", **arguments)


_KIND: dict[str, Any] = {"is_shared": True, "takes_initial": True, "takes_deformation": True}
_KIND["check"] = lambda scan, options: options.batch_for(scan.frames, 1)
PHYRADGS = Method(partial(reconstruct_splats, method="phyradgs"), PRESETS, **_KIND)
R2 = Method(_r2, {"published": R2_PUBLISHED}, **_KIND)
