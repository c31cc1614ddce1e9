"""The splatting methods ``phyradgs`` and ``r2``: radiative Gaussians that are optimised against a scan's frames.

phyradgs is the paper's method, exact splats that follow the gantry's motion; with a static motion it is the paper's
"w/o ST". r2 is R2-Gaussian (Zha et al. 2024): affine splats with its published constants, static by default; micro-views
make it the paper's "R2 w/ ST".

Inside, lengths are divided by half the volume's longest side and densities by a reference (FDK's 99.9th percentile), so that
rates, thresholds and SSIM's constants hold for every scan."""

import time
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import Exact, Scan
from phyradgs_cl.fields import Deformation
from phyradgs_cl.operators.splats.projector import PAIR_KERNELS
from phyradgs_cl.operators.splats.work import Work
from phyradgs_cl.optim import Population
from phyradgs_cl.reconstructors.checkpoint import State
from phyradgs_cl.reconstructors.fdk import static_fdk
from phyradgs_cl.reconstructors.loop import Loop
from phyradgs_cl.reconstructors.method import Method
from phyradgs_cl.reconstructors.result import ProgressReport, Reconstruction, ignore_progress, option_facts
from phyradgs_cl.reconstructors.splats.device import Scale
from phyradgs_cl.reconstructors.splats.options import PRESETS, R2_PUBLISHED, SplatOptions
from phyradgs_cl.reconstructors.splats.run import SplatRun
from phyradgs_cl.reconstructors.splats.start import first_population, internal_scale
from phyradgs_cl.runtime import Runtime

REPORT_EVERY, LEAST_RECORDED = 50, 20


def reconstruct_splats(
    scan: Scan, options: SplatOptions, rt: Runtime, *, method: str, seed: int = 0,
    report: ProgressReport = ignore_progress, resume: State | None = None, initial: np.ndarray | None = None,
    deformation: Deformation | None = None,
) -> Reconstruction:
    """Runs a splatting method under its name ``phyradgs`` or ``r2``.

    ``resume`` continues an interrupted run of the same scan and options from its state. The cloud is drawn from ``initial``
    (nz, ny, nx) in 1/mm, or else from an FDK volume. The cloud and the volume are the reference of ``deformation``, of an
    object that moves."""
    started = time.perf_counter()
    if deformation is not None and deformation.is_still:
        deformation = None
    # rank 0 alone makes the first volume
    of_reference = (rt, scan, options, seed, initial, deformation)
    scale, population, rng = rt.ranks.bcast(first_cloud(*of_reference) if rt.ranks.rank == 0 else None)
    first_count = population.count
    run = SplatRun(rt, scan, options, scale, population, rng, deformation)
    record_every = max(1, min(REPORT_EVERY, options.iterations // LEAST_RECORDED))  # short runs show their course too
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
        # How the motion averaged over time: a frame's largest K, and the share of pairs by rule
        facts |= {"segments": run.frames.most_cells, "time_rules": _first_frame_work(run).rule_shares()}
        facts["motion_phases"] = run.phases()
    if rt.profile:  # the Gaussian-pixel pairs that each kernel evaluates for the last cloud in the first frame
        facts["evaluated_pairs"] = dict.fromkeys(PAIR_KERNELS, _first_frame_work(run).evaluated)
    cloud = cloud.scaled(scale.length_mm, scale.density_per_mm)
    return Reconstruction(volume, scan.grid, cloud, loop.record, facts, loop.state_if_interrupted())


def first_cloud(
    rt: Runtime, scan: Scan, options: SplatOptions, seed: int, initial: np.ndarray | None = None,
    deformation: Deformation | None = None,
) -> tuple[Scale, Population, np.random.Generator]:
    """Returns internal units, the first cloud, and the generator that drew it, from an ``initial`` volume or FDK's."""
    first = static_fdk(rt, scan, deformation) if initial is None else initial
    scale = internal_scale(first, scan.grid)
    rng = np.random.default_rng(seed)
    grid = scan.grid.scaled(1 / scale.length_mm)
    return scale, first_population(first / scale.density_per_mm, grid, options, rng), rng


def _first_frame_work(run: SplatRun) -> Work:
    gaussians, cells, projector = run.cloud.gaussians, run.frames.cells(0), run.frame_step.projector
    run.cloud.activate(run.adam)
    return projector.work(gaussians, cells)


def _r2(scan: Scan, options: SplatOptions, rt: Runtime, **arguments: Any) -> Reconstruction:
    return reconstruct_splats(scan, replace(options, affine=True), rt, method="r2", **arguments)


_KIND = {"is_shared": True, "takes_initial": True, "takes_deformation": True}
PHYRADGS = Method(partial(reconstruct_splats, method="phyradgs"), PRESETS, **_KIND)
R2 = Method(_r2, {"published": R2_PUBLISHED}, **_KIND)
