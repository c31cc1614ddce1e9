"""estimate: what a reconstruction would take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from phyradgs_cl.commands.console import say
from phyradgs_cl.commands.options import Device, file_argument, file_option
from phyradgs_cl.commands.reconstruct import MethodName, MotionName
from phyradgs_cl.estimate import duration, estimate
from phyradgs_cl.reconstructors import method_options
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.settings import run_settings
from phyradgs_cl.workflow import load_scan

EXAMPLE = "Example: phyradgs estimate scan.h5 --method fista-tv --motion per-row"


def estimate_command(
    scan: Annotated[Path, file_argument("SCAN", "Scan file (HDF5, NXtomo).")],
    method: Annotated[
        MethodName | None,  # type: ignore[valid-type]
        typer.Option(help="As for reconstruct.", show_default="phyradgs"),
    ] = None,
    motion: Annotated[
        MotionName | None, typer.Option(help="As for reconstruct.", show_default="the method's")
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="As for reconstruct.", show_default="preset's")
    ] = None,
    gaussians: Annotated[
        int | None, typer.Option(help="Gaussians at the start.", show_default="preset's")
    ] = None,
    preset: Annotated[
        str | None, typer.Option(help="As for reconstruct.", show_default="the method's first")
    ] = None,
    config: Annotated[
        Path | None, file_option("--config", help="TOML file of options, as for reconstruct.")
    ] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any option by name, as for reconstruct."),
    ] = None,
    device: Device = None,
) -> None:
    """Say how long a reconstruction would take and how much memory, from a few iterations of it."""
    given = {
        "method": method.value if method else None,  # type: ignore[attr-defined]
        "motion": motion.value if motion else None,
        "iterations": iterations,
        "gaussians": gaussians,
        "preset": preset,
        "device": device,
    }
    settings = run_settings(config, given, assignments or [])
    options = method_options(settings.method, settings.preset, settings.changes)
    loaded = load_scan(scan)
    loaded.check_timing()
    with settings.naming_origins():
        rt = Runtime(settings.device)
    found = estimate(loaded, settings.method, options, rt, settings.before)
    say(f"{settings.method} on {rt.device.name}, from a trial of {duration(found.trial_seconds)}")
    say(found.text())
