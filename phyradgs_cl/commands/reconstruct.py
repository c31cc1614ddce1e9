"""reconstruct: a scan file to a volume file."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from phyradgs_cl import signals
from phyradgs_cl.commands.console import complain, say
from phyradgs_cl.commands.options import DetectorModel, Device, Output, file_argument, file_option
from phyradgs_cl.progress import Ticker
from phyradgs_cl.reconstructors import METHODS
from phyradgs_cl.report import Preview, check_preview
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import run_settings
from phyradgs_cl.workflow import ReconstructionJob, profile_report, run_reconstruction

EXAMPLE = (
    "Example: phyradgs reconstruct scan.h5 -o volume.h5 --iterations 2000\n\n"
    "Ctrl-C keeps what there is and leaves a checkpoint; --resume goes on from it."
)
MethodName = Enum("MethodName", {name: name for name in METHODS}, type=str)  # type: ignore[misc]


class MotionName(str, Enum):
    static = "static"
    static_start = "static-start"
    micro_views = "micro-views"
    per_row = "per-row"
    exact = "exact"


def reconstruct_command(
    scan: Annotated[Path, file_argument("SCAN", "Scan file (HDF5, NXtomo).")],
    output: Output,
    method: Annotated[
        MethodName | None,  # type: ignore[valid-type]
        typer.Option(
            help="phyradgs: exact splats; r2: R2-Gaussian's affine splats; fdk: analytic; "
            "the others are iterative on voxels.",
            show_default="phyradgs",
        ),
    ] = None,
    motion: Annotated[
        MotionName | None,
        typer.Option(
            help="How frames see the moving gantry: frozen at mid-window (static), at the start, M×N micro-views, "
            "every line at its own times (per-row), or splats that move while lines integrate (exact); "
            "not every method has all of them.",
            show_default="exact for phyradgs, else static",
        ),
    ] = None,
    strips: Annotated[
        int | None,
        typer.Option(help="Strips M of a frame (rolling shutter); means micro-views.", show_default="8"),
    ] = None,
    sub_intervals: Annotated[
        int | None,
        typer.Option(
            help="Sub-intervals N of an exposure (motion blur); for phyradgs means micro-views.",
            show_default="5",
        ),
    ] = None,
    segments: Annotated[
        int | None,
        typer.Option(help="Segments of a frame (motion exact); 0: by the time error.", show_default="0"),
    ] = None,
    time_error: Annotated[
        float | None,
        typer.Option(
            help="Relative error that averaging over time may leave (motion exact).", show_default="0.005"
        ),
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(
            help="Iterations: one frame each for splats, all frames for voxels.",
            show_default="preset's: 3000 for splats",
        ),
    ] = None,
    gaussians: Annotated[
        int | None, typer.Option(help="Gaussians at the start.", show_default="preset's: from the grid")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of cloud, frame order and sub-volumes.", show_default="0")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="Constants: default, paper or released (phyradgs); published (r2); the window of fdk.",
            show_default="the method's first",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        file_option(
            "--config",
            help="TOML file of options (underscores for dashes; docs: formats.md) and the method's constants; "
            "the command line wins.",
        ),
    ] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Any option of the method by name, as in the file: --set tv_weight=0.002 --set order=random. "
            "Docs: methods.md.",
        ),
    ] = None,
    detector_model: Annotated[
        DetectorModel | None,
        typer.Option(
            help="What is averaged over an exposure: line integrals (log) or intensity.",
            show_default="the scan's",
        ),
    ] = None,
    ignore_lag: Annotated[
        bool, typer.Option("--ignore-lag", help="Leave the lag that the scan file states in the frames.")
    ] = False,
    median_filter: Annotated[
        int | None,
        typer.Option(help="Median filter of the frames: 3 or 5 pixels a side, 0 none.", show_default="0"),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the checkpoint of an interrupted run.")
    ] = False,
    checkpoint_every: Annotated[
        float,
        typer.Option(
            metavar="SECONDS",
            help="Keep a checkpoint beside the output so often, for --resume after a kill; 0: on Ctrl-C only.",
        ),
    ] = 600.0,
    preview: Annotated[
        Path | None,
        file_option(
            "--preview", help="PNG of the three middle slices, made anew every five seconds of the run."
        ),
    ] = None,
    profile: Annotated[
        bool,
        typer.Option(
            "--profile", help="Say where the device's time went, kernel by kernel, beside its best rates."
        ),
    ] = False,
    device: Device = None,
) -> None:
    """Reconstruct a scan into a volume; say PSNR and SSIM if the scan carries the truth."""
    given = {
        "method": method.value if method else None,  # type: ignore[attr-defined]
        "motion": motion.value if motion else None,
        "strips": strips,
        "sub_intervals": sub_intervals,
        "segments": segments,
        "time_error": time_error,
        "iterations": iterations,
        "gaussians": gaussians,
        "seed": seed,
        "preset": preset,
        "detector_model": detector_model.value if detector_model else None,
        "ignore_lag": True if ignore_lag else None,
        "median_filter": median_filter,
        "device": device,
    }
    settings = run_settings(config, given, assignments or [])
    job = ReconstructionJob(
        scan,
        output,
        method=settings.method,
        seed=settings.seed,
        preset=settings.preset,
        changes=settings.changes,
        resume=resume,
        config=config,
        before=settings.before,
        checkpoint_every_s=checkpoint_every,
    )

    if preview is not None:
        check_preview(preview, scan, output)
    runtimes: list[Runtime] = []

    def runtime() -> Runtime:
        with settings.naming_origins():
            runtimes.append(Runtime(settings.device, profile=profile))
        return runtimes[-1]

    with Ticker("iteration") as ticker:
        report = Preview(preview, ticker.progress) if preview else ticker.progress
        result, metrics = run_reconstruction(job, runtime, report)
    interrupted = result.facts.get("interrupted_at")
    say(f"{output}: {job.method}, {result.facts['seconds']:.1f} s" + _metrics_text(metrics))
    if profile:
        say(profile_report(runtimes[-1], result))
    if interrupted is not None:
        complain(f"interrupted after iteration {interrupted}: repeat the command with --resume to go on")
        raise typer.Exit(signals.status())


def _metrics_text(metrics: dict[str, float]) -> str:
    return f", PSNR {metrics['psnr_db']:.2f} dB, SSIM {metrics['ssim']:.4f}" if metrics else ""
