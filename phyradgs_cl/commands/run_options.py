"""The options of a reconstruction, given to every command that speaks of one."""

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from phyradgs_cl.acquisition import MOTIONS
from phyradgs_cl.commands import options
from phyradgs_cl.commands.files import file_option, option
from phyradgs_cl.reconstructors import DEFAULT_METHOD, METHODS
from phyradgs_cl.settings import read_settings

# heading of the help: names of parameters; a command shows those that it has
GROUPS = {
    "Basics": ("output", "method", "motion", "size", "iterations"),
    "Volume": ("voxel_mm", "roi_mm", "margin_mm", "initial"),
    "Motion": ("strips", "sub_intervals", "segments", "time_error", "detector_model"),
    "Quality": (
        *("prior", "preset", "assignments", "tune", "holdout", "steps", "median_filter", "ignore_lag", "gaussians", "seed"),
    ),
    "Run": ("device", "memory", "config", "preview", "resume", "checkpoint_every", "profile"),
    "Under mpiexec (docs: cluster.md)": ("batch",),
}
_METHOD = "fdk: analytic; phyradgs, r2: splats; naf, sax-nerf: neural fields; the others: voxels (docs: methods.md)."
_MOTION = (
    "Poses of a frame: one (static, static-start), M×N micro-views, every line at its own times (per-row), or, of "
    "splats, integrals over them (exact)."
)
_PRIOR = "Prior, for fista: dct, tv, nonlocal, nonlocal+dct, piccs or none; MODULE:NAME: a denoiser of your own."
_PRESET = "Constants: default, quick, paper, released (phyradgs); published (r2, naf, sax-nerf); a window (fdk)."
_CONFIG = "TOML file of options, with underscores for dashes (docs: formats.md); the command line wins."
_SET = "An option of the method by name: --set tv_weight=0.002 (docs: methods.md)."
_TUNE = "Option that held-out pixels choose: tv_weight, prior_weight=0.4,0.8,1.6, iterations (docs: methods.md)."


def _asked(kind: Any, help: str, default: str, *flags: str, **more: Any) -> Any:
    return Annotated[kind | None, option(help, default, *flags, **more)]


RUN_OPTIONS: dict[str, Any] = {
    "method": _asked(str, _METHOD, DEFAULT_METHOD, metavar=f"{'|'.join(METHODS)}|MODULE:NAME"),
    "motion": _asked(
        Literal[MOTIONS],
        _MOTION,
        "per-row",
    ),
    "strips": _asked(int, "Strips M of a frame; means micro-views.", "8"),
    "sub_intervals": _asked(
        int, "Sub-intervals N of an exposure; for phyradgs means micro-views.", "5"
    ),
    "segments": _asked(int, "Segments of a frame (exact); 0: by --time-error.", "0"),
    "time_error": _asked(float, "Relative error of averaging over time (exact).", "0.005"),
    "iterations": _asked(
        int, "Iterations: of voxels all frames each, of splats one frame (then 3000).", "35"
    ),
    "prior": _asked(str, _PRIOR, "dct", metavar="NAME|MODULE:NAME"),
    "gaussians": _asked(int, "Gaussians at the start, of splats.", "from the grid"),
    "size": options.Size,
    "voxel_mm": options.VoxelMm,
    "roi_mm": options.RoiMm,
    "margin_mm": options.MarginMm,
    "seed": _asked(int, "Seed of the random numbers.", "0"),
    "preset": _asked(str, _PRESET, "the method's first"),
    "batch": _asked(
        int, "Frames per step, for splats.", "as many as ranks", metavar="B"
    ),
    "config": Annotated[Path | None, file_option(_CONFIG, "--config")],
    "assignments": Annotated[list[str] | None, option(_SET, True, "--set", metavar="NAME=VALUE")],
    "detector_model": _asked(
        options.DetectorModel,
        "What an exposure averages: line integrals (log) or intensity.",
        "the scan's",
    ),
    "ignore_lag": Annotated[
        bool, option("Leave the scan's lag in the frames.", True, "--ignore-lag")
    ],
    "steps": options.Steps,
    "holdout": _asked(
        float, "Pixels hidden from the method, to measure its error on them.", "0", metavar="PERCENT"
    ),
    "tune": _asked(str, _TUNE, "none", metavar="NAME[=VALUES]"),
    "median_filter": _asked(int, "Median filter of the frames, of 3 or 5 pixels a side.", "0"),
    "device": options.Device,
    "memory": options.Memory,
}


def with_run_options(*without: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Gives a command the options of a reconstruction, except ``without``, in place of its parameter ``settings``.

    Typer reads a command's signature, so the signature lists the options; the command gets the ``Settings`` that they make.
    """
    names = [name for name in RUN_OPTIONS if name not in without]

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def called(**values: Any) -> None:
            options = {name: values.pop(name) for name in names}
            given = {name: None if value is False else value for name, value in options.items()}  # False: a flag not given
            config, assignments = given.pop("config"), given.pop("assignments") or []
            command(settings=read_settings(config, given, assignments), **values)

        called.__signature__ = _signature(command, names)  # type: ignore[attr-defined]
        return called

    return decorated


def _signature(command: Callable[..., None], names: list[str]) -> inspect.Signature:
    """Returns the command's signature with the options of a reconstruction in place of ``settings``."""
    parameters: list[inspect.Parameter] = []
    for own in inspect.signature(command, eval_str=True).parameters.values():
        if own.name == "settings":
            for name in names:
                default = False if get_args(kind := RUN_OPTIONS[name])[0] is bool else None
                parameters.append(inspect.Parameter(name, own.KEYWORD_ONLY, default=default, annotation=kind))
        else:
            parameters.append(own.replace(kind=own.KEYWORD_ONLY))
    return inspect.Signature(parameters)
