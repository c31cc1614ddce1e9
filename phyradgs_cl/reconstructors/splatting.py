"""The engine under ``phyradgs`` and ``r2``: radiative Gaussians optimised against a scan's frames.

The one place where scan, operators, objective and optimiser meet. Inside, lengths are divided by half the
volume's longest side and densities by a reference (FDK's 99.9th percentile), so that rates, thresholds and SSIM's
constants mean the same for every scan; both are undone on the way out.
"""

from __future__ import annotations

import json
import logging
import time

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import NumericalError
from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.fields.gaussians import SCALE
from phyradgs_cl.objective import ImageLoss, TotalVariation
from phyradgs_cl.operators import DeviceGaussians, SplatProjector, Voxeliser, voxelise
from phyradgs_cl.operators.layout import pad_columns, stride_of
from phyradgs_cl.optim import DeviceAdam, Population, control_density, prune
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.initial_cloud import initial_cloud
from phyradgs_cl.reconstructors.interrupt import stop_on_interrupt
from phyradgs_cl.reconstructors.result import (
    Progress,
    ProgressReport,
    Reconstruction,
    State,
    history,
    history_arrays,
    state_arrays,
)
from phyradgs_cl.reconstructors.splat_frames import DeviceFrames, Scale
from phyradgs_cl.reconstructors.splat_options import SplatOptions
from phyradgs_cl.runtime import Runtime

REPORT_EVERY = 50
log = logging.getLogger(__name__)
_REFERENCE_PERCENTILE = 99.9


def reconstruct_splats(
    scan: Scan,
    options: SplatOptions,
    rt: Runtime,
    seed: int,
    report: ProgressReport,
    method: str,
    resume: State | None,
) -> Reconstruction:
    """Runs a splatting method; the public doors are ``phyradgs`` and ``r2``.

    ``resume`` continues an interrupted run of the same scan and options from its state.
    """
    started = time.perf_counter()
    fdk = static_fdk(rt, scan)
    scale = internal_scale(fdk, scan.grid)
    grid = scan.grid.scaled(1 / scale.length_mm)
    rng = np.random.default_rng(seed)
    population = first_population(fdk / scale.density_per_mm, grid, options, rng)
    first_count = population.count
    run = SplatRun(rt, scan, options, scale, population, rng)
    if resume is not None:
        run.restore(resume)
    run.optimise(report, started)
    cloud = run.present_cloud()
    volume = run.present_volume()[0]
    facts = {
        "method": method,
        "options": options.as_dict(),
        "seed": seed,
        "unit_length_mm": scale.length_mm,
        "unit_density_per_mm": scale.density_per_mm,
        "gaussians_asked": options.gaussians_for(grid),
        "gaussians_first": first_count,
        "gaussians": cloud.count,
        "seconds": time.perf_counter() - started + run.seconds_before,
        "interrupted_at": run.interrupted_at,
        "detector_model": "log" if run.frames.intensity_unit is None else "intensity",
    }
    if options.motion.name == "exact":
        facts |= run.time_facts()
    if rt.profile:
        facts["evaluated_pairs"] = run.evaluated_pairs()
    state = run.state() if run.interrupted_at is not None else None
    cloud = cloud.scaled(scale.length_mm, scale.density_per_mm)
    return Reconstruction(volume, scan.grid, cloud, run.record, facts, state)


def internal_scale(fdk: np.ndarray, grid: Grid) -> Scale:
    """Half the longest side, and a high percentile of a first volume (1 where that is not positive)."""
    reference = float(np.percentile(fdk, _REFERENCE_PERCENTILE))
    if not np.isfinite(reference):
        raise NumericalError("projections", "values that overflow in FDK", "line integrals of order 1")
    return Scale(grid.half_longest_mm, reference if reference > 0 else 1.0 / grid.half_longest_mm)


class SplatRun:
    """The state of one optimisation: everything that changes from iteration to iteration."""

    def __init__(
        self,
        rt: Runtime,
        scan: Scan,
        options: SplatOptions,
        scale: Scale,
        population: Population,
        rng: np.random.Generator,
    ) -> None:
        self.rt, self.options, self.scale, self.rng = rt, options, scale, rng
        self.grid = scan.grid.scaled(1 / scale.length_mm)
        self.activation = options.activation(self.grid)
        self.frames = DeviceFrames(rt, scan, options, scale)
        self.projector = SplatProjector(
            rt,
            self.frames.lines,
            self.frames.width,
            affine=options.affine,
            cutoff_sigma=options.cutoff_sigma,
            time_error=options.motion.time_error,
            pixel_footprint=options.pixel_footprint,
            intensity_unit=self.frames.intensity_unit,
        )
        self.loss = ImageLoss(
            rt,
            self.frames.lines,
            self.frames.width,
            self.projector.pitch,
            options.ssim_weight,
            options.l1_weight,
            options.poisson_weight,
        )
        edge = [min(options.tv_edge, n) for n in self.grid.shape]
        self.crop = Voxeliser(rt, (edge[0], edge[1], edge[2]), cutoff_sigma=options.cutoff_sigma)
        self.tv = TotalVariation(rt, self.crop.shape, self.crop.pitch)
        self.adam = DeviceAdam(rt, self.activation)
        self.iteration = 0
        self.interrupted_at: int | None = None
        self.record: list[dict[str, float]] = []
        self.seconds_before = 0.0
        self._started = time.perf_counter()
        self._queue: list[int] = []
        self._load(population)

    # --- the loop ---------------------------------------------------------------------------------------

    def optimise(self, report: ProgressReport, started: float) -> None:
        """All iterations; Ctrl-C (or a report that raises KeyboardInterrupt) ends the run after the one under way."""
        self._started = started - self.seconds_before
        total = self.options.iterations
        with stop_on_interrupt() as request:
            while self.iteration < total and self.interrupted_at is None:
                self.step()
                if self.iteration % REPORT_EVERY == 0 or self.iteration == total:
                    self._report(report)
                if request.is_set and self.iteration < total:
                    self.interrupted_at = self.iteration

    def _report(self, report: ProgressReport) -> None:
        seconds = time.perf_counter() - self._started
        facts = {"loss": self._checked_loss(), "gaussians": self.gaussians.count, "seconds": seconds}
        self.record.append({"iteration": self.iteration, **facts})
        now = Progress(
            self.iteration, self.options.iterations, **facts, state=self.state, volume=self.present_volume
        )
        try:
            report(now)
        except KeyboardInterrupt:
            self.interrupted_at = self.iteration

    def step(self) -> None:
        """One frame: render, compare, go back, regularise, move, and now and then control the density."""
        options, gaussians = self.options, self.gaussians
        frame = self._next_frame()
        cells, measured, mask, pixels = self.frames.get(frame)
        self.adam.activate(self.raw, gaussians.rows, gaussians.count, gaussians.stride)
        rendered = self.projector.forward(gaussians, cells)
        trust = self.frames.transmission(frame)
        by_image = self.loss.evaluate(rendered, measured, mask, pixels, trust)
        self.projector.backward(gaussians, cells, by_image, self.gradients)
        if options.tv_weight > 0:
            self._add_total_variation()
        late = self.iteration >= options.parameter_terms_from
        self.adam.chain(
            self.raw,
            gaussians.rows,
            self.gradients,
            self.statistics,
            gaussians.count,
            gaussians.stride,
            density_weight=options.density_weight if late else 0.0,
            shape_weight=options.shape_weight if late else 0.0,
            shape_ratio=options.shape_ratio,
            shape_floor=options.shape_floor,
        )
        rates = options.rates.at(self.iteration / max(options.iterations, 1))
        self.iteration += 1
        self.adam.step(self.raw, self.gradients, self.moments, gaussians.stride, rates, self.iteration)
        if options.control.is_due(self.iteration, options.iterations):
            self._control_density()

    def _next_frame(self) -> int:
        if not self._queue:
            self._queue = self.rng.permutation(self.frames.count).tolist()
        return self._queue.pop()

    def _add_total_variation(self) -> None:
        start = [
            int(self.rng.integers(n - edge + 1))
            for n, edge in zip(self.grid.shape, self.crop.shape, strict=True)
        ]
        volume = self.crop.forward(self.gaussians, self.grid, (start[0], start[1], start[2]))
        by_volume = self.tv.evaluate(volume)
        weight = self.options.tv_weight
        self.crop.backward(self.gaussians, self.grid, by_volume, self.gradients, add=True, weight=weight)

    def _checked_loss(self) -> float:
        loss = self.loss.value()
        if not np.isfinite(loss):
            raise NumericalError(
                "loss",
                f"{loss} at iteration {self.iteration}",
                "a finite number",
                "check the scan for extreme values",
            )
        return loss

    def time_facts(self) -> dict[str, object]:
        """How the motion ``exact`` averaged over time: the largest K of a frame, and the share of pairs by rule."""
        self.adam.activate(self.raw, self.gaussians.rows, self.gaussians.count, self.gaussians.stride)
        cells = self.frames.get(0)[0]
        self.projector.forward(self.gaussians, cells)
        shares = self.projector.work(self.gaussians, cells).rule_shares()
        return {"segments": self.frames.most_cells, "time_rules": shares}

    def evaluated_pairs(self) -> dict[str, int]:
        """Gaussian–pixel pairs that a launch evaluates, of the last cloud in the first frame, by kernel."""
        self.adam.activate(self.raw, self.gaussians.rows, self.gaussians.count, self.gaussians.stride)
        cells = self.frames.get(0)[0]
        self.projector.forward(self.gaussians, cells)
        evaluated = self.projector.work(self.gaussians, cells).evaluated
        return {"splat_forward": evaluated, "splat_backward": evaluated}

    # --- stop and go on ---------------------------------------------------------------------------------

    def state(self) -> dict[str, np.ndarray]:
        """Everything that the next iteration depends on, and what there is to tell of those before."""
        population = self._population()
        return {
            "raw": population.raw,
            "moments": population.moments,
            "statistics": self.rt.download(self.statistics)[:, : self.gaussians.count],
            "iteration": np.array(self.iteration),
            "queue": np.array(self._queue, np.int64),
            "rng": np.array(json.dumps(self.rng.bit_generator.state)),
            **history_arrays(self.record, time.perf_counter() - self._started),
        }

    def restore(self, state: State) -> None:
        """The inverse of ``state``: raw (11, G), moments (2, 11, G), statistics (2, G), and where the run was."""
        names = ("raw", "moments", "statistics", "iteration", "queue", "rng")
        raw, moments, statistics, iteration, queue, rng = state_arrays(state, names)
        self._load(Population(raw, moments))
        padded = np.zeros((2, self.gaussians.stride), np.float32)
        padded[:, : self.gaussians.count] = statistics
        self.rt.write(self.statistics, padded)
        self.iteration, self._queue = int(iteration), [int(f) for f in queue]
        self.rng.bit_generator.state = json.loads(str(rng))
        self.record, self.seconds_before = history(state)

    # --- the population -----------------------------------------------------------------------------------

    def parameters(self) -> np.ndarray:
        """Parameter rows (11, G) float64 in internal units."""
        return self.activation.apply(self._population().raw.astype(np.float64))

    def present_cloud(self) -> Gaussians:
        """The cloud in internal units, without what density control would remove for its shape."""
        rows = self.parameters()
        return Gaussians.from_rows(rows[:, self.options.control.allows(rows[SCALE])])

    def present_volume(self) -> tuple[np.ndarray, Grid]:
        """The cloud as a volume (nz, ny, nx) in 1/mm, on the scan's grid in mm."""
        cloud = Gaussians.from_rows(self.parameters())
        if (
            self.options.pixel_footprint
        ):  # its field is as sharp as it is: voxels average over their volume, too
            cloud = cloud.averaged(self.grid.voxel_size_mm[::-1])
        volume = voxelise(self.rt, cloud.rows(), self.grid, cutoff_sigma=self.options.cutoff_sigma)
        return volume * np.float32(self.scale.density_per_mm), self.grid.scaled(self.scale.length_mm)

    def _population(self) -> Population:
        count = self.gaussians.count
        return Population(self.rt.download(self.raw)[:, :count], self.rt.download(self.moments)[:, :, :count])

    def _control_density(self) -> None:
        sums = self.rt.download(self.statistics)[:, : self.gaussians.count].astype(np.float64)
        statistic = sums[0] / np.maximum(sums[1], 1)
        half = np.array(self.grid.size_mm[::-1]) / 2
        centre = np.array(self.grid.offset_mm[::-1])
        box = np.stack([centre - half, centre + half])
        population = self._population()
        self._load(
            control_density(population, statistic, self.activation, self.options.control, box, self.rng)
        )

    def _load(self, population: Population) -> None:
        count, stride = population.count, stride_of(population.count)
        moments = np.zeros((2, 11, stride), np.float32)
        moments[:, :, :count] = population.moments
        self.raw = self.rt.upload(pad_columns(population.raw))
        self.moments = self.rt.upload(moments)
        self.gradients = self.rt.zeros((13, stride))
        self.statistics = self.rt.zeros((2, stride))
        self.gaussians = DeviceGaussians(self.rt.zeros((11, stride)), count, stride)


def first_population(
    volume: np.ndarray, grid: Grid, options: SplatOptions, rng: np.random.Generator
) -> Population:
    """The raw parameters of the initial cloud, drawn from an FDK volume in internal units."""
    activation = options.activation(grid)
    asked = options.gaussians_for(grid)
    cloud = initial_cloud(
        volume,
        grid,
        asked,
        threshold=options.initial_threshold,
        density_share=options.initial_density,
        scale_bounds=(activation.scale_min, activation.scale_max),
        scale_factor=options.initial_scale,
        rng=rng,
    )
    if options.asks_for_gaussians and cloud.count < asked:
        log.warning(
            "%d Gaussians asked for, %d voxels of the first volume attenuate enough: starting with %d",
            asked,
            cloud.count,
            cloud.count,
        )
    raw = activation.invert(cloud.rows())
    half = np.array(grid.size_mm[::-1]) / 2
    box = np.stack([np.array(grid.offset_mm[::-1]) - half, np.array(grid.offset_mm[::-1]) + half])
    return prune(Population(raw, np.zeros((2, *raw.shape))), activation, options.control, box)
