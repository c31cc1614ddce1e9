"""The loop around a neural field: scan and options to trainer, progress, record, Ctrl-C, going on.

The one place where the scan, the field and its training meet; PyTorch is imported when a run begins.
"""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError, NumericalError
from phyradgs_cl.neural import NeuralOptions, require_torch
from phyradgs_cl.reconstructors.checked_state import (
    check_array,
    checked_history,
    count_of,
    restore_generator,
)
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.interrupt import stop_on_interrupt
from phyradgs_cl.reconstructors.result import (
    Progress,
    ProgressReport,
    Reconstruction,
    State,
    history_arrays,
    state_arrays,
)
from phyradgs_cl.reconstructors.splat_start import internal_scale
from phyradgs_cl.runtime import Runtime

if TYPE_CHECKING:
    from phyradgs_cl.neural.trainer import Trainer


def reconstruct_neural(
    scan: Scan,
    options: NeuralOptions,
    rt: Runtime,
    seed: int,
    report: ProgressReport,
    method: str,
    resume: State | None,
) -> Reconstruction:
    """Runs a neural method; the public doors are ``naf`` and ``sax_nerf``.

    ``rt`` makes the FDK volume that sets the unit of attenuation; the rest is PyTorch's. ``resume`` continues an
    interrupted run of the same scan and options from its state. Raises InputError where PyTorch is not installed.
    """
    require_torch(f"--method {method}")
    from phyradgs_cl.neural.fields import first_field
    from phyradgs_cl.neural.torch_device import torch_device
    from phyradgs_cl.neural.trainer import Trainer

    started = time.perf_counter()
    device = torch_device(options.torch_device)
    scale = internal_scale(static_fdk(rt, scan), scan.grid)
    field = first_field(options, max(scan.grid.shape), seed)
    trainer = Trainer(scan, options, field, device, scale.density_per_mm, seed)
    run = _Run(trainer, options.iterations, report, started)
    if resume is not None:
        run.restore(resume)
    run.loop()
    facts: dict[str, object] = {
        "method": method,
        "options": asdict(options),
        "seed": seed,
        "unit_length_mm": scale.length_mm,
        "unit_density_per_mm": scale.density_per_mm,
        "detector_model": trainer.model,
        "parameters": trainer.parameters,
        "levels": options.levels_for(max(scan.grid.shape)),
        "samples": trainer.samples,
        "times": trainer.times,
        "iterations": trainer.passes,
        "torch_device": str(device),
        "torch_version": _torch_version(),
        "seconds": time.perf_counter() - run.started,
        "interrupted_at": trainer.passes if run.is_interrupted else None,
    }
    volume = trainer.volume(scan.grid)
    state = run.state() if run.is_interrupted else None
    return Reconstruction(volume, scan.grid, record=run.record, facts=facts, state=state)


class _Run:
    """Where the run is, and whether somebody has stopped it: passes over the frames, reported one by one."""

    def __init__(self, trainer: Trainer, iterations: int, report: ProgressReport, started: float) -> None:
        self.trainer, self.iterations, self.report, self.started = trainer, iterations, report, started
        self.record: list[dict[str, float]] = []
        self.is_interrupted = False

    def loop(self) -> None:
        """All passes; Ctrl-C (or a report that raises KeyboardInterrupt) ends the run after the step under way."""
        trainer = self.trainer
        with stop_on_interrupt() as request:
            while trainer.passes < self.iterations and not self.is_interrupted:
                trainer.step()
                if trainer.is_between_passes:
                    self._report()
                self.is_interrupted |= request.is_set
                self.is_interrupted &= trainer.passes < self.iterations

    def state(self) -> dict[str, np.ndarray]:
        """What the trainer and a loop need to go on from here."""
        so_far = history_arrays(self.record, time.perf_counter() - self.started)
        return {**self.trainer.state(), **so_far}

    def restore(self, state: State) -> None:
        """Goes on from a state; raises InputError for one that this run cannot have left."""
        trainer, frames = self.trainer, self.trainer.scan.frames
        names = ("parameters", "moments", "queue", "losses")
        parameters, moments, queue, losses = state_arrays(state, names)
        check_array("parameters", parameters, (trainer.parameters,), np.float32)
        check_array("moments", moments, (2, trainer.parameters), np.float32)
        steps = count_of(state, "steps", self.iterations * frames)
        check_array("queue", queue, (frames - steps % frames,), np.int64)
        if not 0 <= queue.min() <= queue.max() < frames:
            found, expected = f"{queue.min()} to {queue.max()}", f"frames from 0 to {frames - 1}"
            raise InputError("checkpoint, array queue", found, expected, "start without --resume")
        check_array("losses", losses, (steps % frames or min(steps, frames),), np.float64)
        restore_generator(trainer.rng, state)
        self.record, before_s = checked_history(state)
        self.started -= before_s
        trainer.steps, trainer.queue, trainer.losses = steps, queue.tolist(), losses.tolist()
        trainer.restore(parameters, moments, count_of(state, "updates", steps))

    def _report(self) -> None:
        trainer = self.trainer
        loss = float(np.mean(trainer.losses))
        if not np.isfinite(loss):
            found = f"{loss} at iteration {trainer.passes}"
            remedy = "check the scan for extreme values, or lower the rate"
            raise NumericalError("loss", found, "a finite number", remedy)
        seconds = time.perf_counter() - self.started
        self.record.append({"iteration": trainer.passes, "loss": loss, "seconds": seconds})
        grid = trainer.scan.grid
        now = Progress(
            *(trainer.passes, self.iterations, loss, 0, seconds),
            state=self.state,
            volume=lambda: (trainer.volume(grid), grid),
        )
        try:
            self.report(now)
        except KeyboardInterrupt:
            self.is_interrupted = True


def _torch_version() -> str:
    from importlib.metadata import version

    return version("torch")
