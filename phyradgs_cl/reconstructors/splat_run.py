"""One optimisation of radiative Gaussians: its loop, and everything that changes from iteration to iteration."""

from __future__ import annotations

import json
import time

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import NumericalError
from phyradgs_cl.fields import Gaussians, Grid
from phyradgs_cl.fields.gaussians import SCALE
from phyradgs_cl.optim import Population
from phyradgs_cl.reconstructors.checked_state import (
    check_cloud,
    checked_history,
    count_of,
    restore_generator,
)
from phyradgs_cl.reconstructors.interrupt import stop_on_interrupt
from phyradgs_cl.reconstructors.reporting import report_once
from phyradgs_cl.reconstructors.result import (
    Progress,
    ProgressReport,
    State,
    history_arrays,
    state_arrays,
)
from phyradgs_cl.reconstructors.splat_cloud import DeviceCloud
from phyradgs_cl.reconstructors.splat_division import Batch, Division, Undivided
from phyradgs_cl.reconstructors.splat_domain import Domain
from phyradgs_cl.reconstructors.splat_frames import Scale
from phyradgs_cl.reconstructors.splat_objective import FrameObjective
from phyradgs_cl.reconstructors.splat_options import SplatOptions
from phyradgs_cl.reconstructors.splat_shared import SharedFrames
from phyradgs_cl.reconstructors.splat_start import box_of
from phyradgs_cl.runtime import Runtime

REPORT_EVERY, LEAST_RECORDED = 50, 20
_SILENT_S = 10.0


def record_interval(iterations: int) -> int:
    """Iterations from line to line of the record: as for reports, but fewer in short runs, to show how they went."""
    return max(1, min(REPORT_EVERY, iterations // LEAST_RECORDED))


def division_of(rt: Runtime, options: SplatOptions, batch: int) -> Division:
    """How ``rt``'s ranks divide the work of steps of ``batch`` frames."""
    if options.split == "domain":
        return Domain(rt.ranks, options.parts)
    is_divided = rt.ranks.size > 1 or batch > 1 or options.parts > 1
    return SharedFrames(rt.ranks, batch, options.parts) if is_divided else Undivided()


class SplatRun:
    """The state of one optimisation. ``population`` is all of it, whatever part of it this rank will have."""

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
        self.batch = options.batch_for(scan.frames, rt.ranks.size)
        self.division = division_of(rt, options, self.batch)
        self.objective = FrameObjective(rt, scan, options, scale, self.grid, self.division.keeps_frames)
        self.frames = self.objective.frames
        self.iteration = 0
        self.interrupted_at: int | None = None
        self.record: list[dict[str, float]] = []
        self.seconds_before = 0.0
        self.control_seconds, self.control_rounds = 0.0, 0
        self._started = self._reported = time.perf_counter()
        self._queue: list[int] = []
        self._load(population)

    # --- the loop ---------------------------------------------------------------------------------------

    def optimise(self, report: ProgressReport, started: float) -> None:
        """All iterations; Ctrl-C (or a report that raises KeyboardInterrupt) ends the run after the one under way."""
        self._started = started - self.seconds_before
        total = self.options.iterations
        with stop_on_interrupt() as request:
            while self.iteration < total and self.interrupted_at is None:
                before = self.iteration
                self.step()
                if self._passes(record_interval(total), before):
                    self._keep_record()
                if self._passes(REPORT_EVERY, before) or self._was_silent_long():
                    self._report(report)
                if self.rt.ranks.any(request.is_set) and self.iteration < total:
                    self.interrupted_at = self.iteration

    def _passes(self, every: int, before: int) -> bool:
        """Whether the step from iteration ``before`` has reached a multiple of ``every``, or the end."""
        return self.iteration // every > before // every or self.iteration == self.options.iterations

    def _was_silent_long(self) -> bool:
        """Whether iterations are so slow that a user wonders; ranks would have to agree on a time, and report by number."""
        return self.rt.ranks.size == 1 and time.perf_counter() - self._reported > _SILENT_S

    def _facts(self) -> dict[str, float]:
        seconds = time.perf_counter() - self._started
        return {"loss": self._checked_loss(), "gaussians": self.count, "seconds": seconds}

    def _keep_record(self) -> None:
        self.record.append({"iteration": self.iteration, **self._facts()})

    def _report(self, report: ProgressReport) -> None:
        facts, self._reported = self._facts(), time.perf_counter()
        now = Progress(
            self.iteration, self.options.iterations, **facts, state=self.state, volume=self.present_volume
        )
        if report_once(self.rt.ranks, report, now):
            self.interrupted_at = self.iteration

    def step(self) -> None:
        """One batch of frames: render, compare, go back, regularise, move, and now and then control the density."""
        options, before = self.options, self.iteration
        batch = self._next_batch()
        for cloud in self.clouds:
            cloud.activate(self.objective.adam)
        self.division.differentiate(self, batch)
        rates = options.rates.at(before / max(options.iterations, 1)) * np.sqrt(len(batch.frames))
        self.iteration += len(batch.frames)
        step = -(-self.iteration // self.batch)
        for cloud in self.clouds:
            cloud.move(self.objective.adam, rates, step)
        passed = range(before + 1, self.iteration + 1)
        if any(options.control.is_due(iteration, options.iterations) for iteration in passed):
            self._control_density()

    def _next_batch(self) -> Batch:
        frames = []
        for _ in range(min(self.batch, max(self.options.iterations - self.iteration, 1))):
            if not self._queue:
                self._queue = self.rng.permutation(self.frames.count).tolist()
            frames.append(self._queue.pop())
        crops = len(frames) if self.options.tv_weight > 0 else 0
        corners = [self.objective.corner(self.rng) for _ in range(crops)]
        return Batch(frames, corners, late=self.iteration >= self.options.parameter_terms_from)

    def _checked_loss(self) -> float:
        loss = self.division.loss(self)
        if not np.isfinite(loss):
            raise NumericalError(
                "loss",
                f"{loss} at iteration {self.iteration}",
                "a finite number",
                "check the scan for extreme values",
            )
        return loss

    # --- stop and go on ---------------------------------------------------------------------------------

    def state(self) -> dict[str, np.ndarray]:
        """Everything that the next iteration depends on, and what there is to tell of those before."""
        own, whole = self._population(), self.division.whole
        return {
            "raw": whole(own.raw),
            "moments": whole(own.moments),
            "statistics": whole(self._statistics()),
            "iteration": np.array(self.iteration),
            "batch": np.array(self.batch),
            "queue": np.array(self._queue, np.int64),
            "rng": np.array(json.dumps(self.rng.bit_generator.state)),
            **history_arrays(self.record, time.perf_counter() - self._started),
        }

    def restore(self, state: State) -> None:
        """The inverse of ``state``, on any number of ranks: raw (11, G), moments (2, 11, G), statistics (2, G), …"""
        check_cloud(state, self.frames.count)
        raw, moments, statistics, queue = state_arrays(state, ("raw", "moments", "statistics", "queue"))
        iteration = count_of(state, "iteration", self.options.iterations)
        self.batch = max(count_of(state, "batch", self.frames.count), 1)
        record, seconds_before = checked_history(state)
        restore_generator(self.rng, state)
        self.division = division_of(self.rt, self.options, self.batch)
        self._load(Population(raw, moments))
        for cloud, part in zip(self.clouds, self.division.runs(self.count), strict=True):
            cloud.write_statistics(statistics[:, part.start : part.stop])
        self.iteration, self._queue = iteration, [int(f) for f in queue]
        self.record, self.seconds_before = record, seconds_before

    # --- the population -----------------------------------------------------------------------------------

    def parameters(self) -> np.ndarray:
        """Parameter rows (11, own) float64 of this rank's Gaussians in internal units."""
        return self.activation.apply(self._population().raw.astype(np.float64))

    def present_cloud(self) -> Gaussians:
        """The whole cloud in internal units, without what density control would remove for its shape."""
        rows = self.activation.apply(self.division.whole(self._population().raw).astype(np.float64))
        return Gaussians.from_rows(rows[:, self.options.control.allows(rows[SCALE])])

    def present_volume(self) -> tuple[np.ndarray, Grid]:
        """The cloud as a volume (nz, ny, nx) in 1/mm, on the scan's grid in mm."""
        cloud = Gaussians.from_rows(self.parameters())
        if (
            self.options.pixel_footprint
        ):  # its field is as sharp as it is: voxels average over their volume, too
            cloud = cloud.averaged(self.grid.voxel_size_mm[::-1])
        volume = self.division.voxelise(self, cloud.rows(), self.grid)
        return volume * np.float32(self.scale.density_per_mm), self.grid.scaled(self.scale.length_mm)

    def _population(self) -> Population:
        """This rank's part of the population."""
        parts = [cloud.population() for cloud in self.clouds]
        raw, moments = [part.raw for part in parts], [part.moments for part in parts]
        return Population(np.concatenate(raw, axis=1), np.concatenate(moments, axis=2))

    def _statistics(self) -> np.ndarray:
        return np.concatenate([cloud.read_statistics() for cloud in self.clouds], axis=1)

    def _control_density(self) -> None:
        sums = self._statistics().astype(np.float64)
        begun = time.perf_counter()  # the statistics were the last to come: the device has nothing left to do
        statistic = sums[0] / np.maximum(sums[1], 1)
        own = self.division.control(self, self._population(), statistic, box_of(self.grid))
        count = self.division.whole(np.zeros(own.count, np.int8)).size
        self._place(own, count)
        self.control_seconds += time.perf_counter() - begun
        self.control_rounds += 1

    def _load(self, population: Population) -> None:
        """Puts this rank's part of a whole population on the device."""
        runs = self.division.runs(population.count)
        self._place(population.take(np.arange(runs[0].start, runs[-1].stop)), population.count)

    def _place(self, own: Population, count: int) -> None:
        """Puts this rank's part, of ``count`` in all, on the device."""
        self.count = count
        runs = self.division.runs(count)
        first = runs[0].start
        self.clouds: list[DeviceCloud] = []  # the old go before the new come
        self.clouds = [
            DeviceCloud(self.rt, own.take(np.arange(part.start - first, part.stop - first))) for part in runs
        ]
