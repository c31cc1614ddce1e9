"""The options of a reconstruction, given to every command that speaks of one."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from phyradgs_cl.acquisition import MOTIONS
from phyradgs_cl.commands import options
from phyradgs_cl.commands.files import file_option, option
from phyradgs_cl.reconstructors import DEFAULT_METHOD, METHODS
from phyradgs_cl.settings import RunSettings, run_settings
from phyradgs_cl.workflow import ReconstructionJob

_METHOD = (
    "phyradgs: exact splats; r2: R2-Gaussian's affine splats; fdk: analytic; "
    "naf, sax-nerf: neural fields; MODULE:NAME: a function of your own (docs: api.md); "
    "the others are iterative on voxels."
)
_MOTION = (
    "How frames see the moving gantry: frozen at mid-window (static), at the start, M×N micro-views, "
    "every line at its own times (per-row), or splats that move while lines integrate (exact); "
    "not every method has all of them."
)
_PRIOR = (
    "The prior, for fista: dct, tv, nonlocal, nonlocal+dct, piccs or none; MODULE:NAME: a denoiser of your own "
    "(docs: methods.md)."
)
_PRESET = "Constants: default, quick, paper or released (phyradgs); published (r2, naf, sax-nerf); the window of fdk."
_CONFIG = (
    "TOML file of options (underscores for dashes; docs: formats.md) and the method's constants; "
    "the command line wins."
)
_SET = (
    "Any option of the method by name, as in the file: --set tv_weight=0.002 --set order=random. "
    "Docs: methods.md."
)
_TUNE = (
    "Option of the method that the scan chooses, by the error on pixels that trials do not see: tv_weight, "
    "prior_weight=0.4,0.8,1.6, iterations. Docs: methods.md."
)
_RANKS = "Under mpiexec (docs: cluster.md)"  # a panel of its own at the end of a command's help


def _asked(kind: Any, help: str, default: str, *flags: str, **more: Any) -> Any:
    return Annotated[kind | None, option(help, default, *flags, **more)]


RUN_OPTIONS: dict[str, Any] = {
    "method": _asked(str, _METHOD, DEFAULT_METHOD, metavar=f"{'|'.join(METHODS)}|MODULE:NAME"),
    "motion": _asked(
        Literal[MOTIONS],
        _MOTION,
        "each line at its own times for fista, phyradgs and fused; else static",
    ),
    "strips": _asked(int, "Strips M of a frame (rolling shutter); means micro-views.", "8"),
    "sub_intervals": _asked(
        int, "Sub-intervals N of an exposure (motion blur); for phyradgs means micro-views.", "5"
    ),
    "segments": _asked(int, "Segments of a frame (motion exact); 0: by the time error.", "0"),
    "time_error": _asked(float, "Relative error that averaging over time may leave (motion exact).", "0.005"),
    "iterations": _asked(
        int, "Iterations: one frame each for splats, all frames for voxels.", "preset's: 3000 for splats"
    ),
    "prior": _asked(str, _PRIOR, "dct", metavar="NAME|MODULE:NAME"),
    "gaussians": _asked(int, "Gaussians at the start.", "preset's: from the grid"),
    "size": options.Size,
    "voxel_mm": options.VoxelMm,
    "roi_mm": options.RoiMm,
    "margin_mm": options.MarginMm,
    "seed": _asked(int, "Seed of cloud, frame order and sub-volumes.", "0"),
    "preset": _asked(str, _PRESET, "the method's first"),
    "batch": _asked(
        int, "Frames per step, for splats.", "as many as ranks", metavar="B", rich_help_panel=_RANKS
    ),
    "config": Annotated[Path | None, file_option(_CONFIG, "--config")],
    "assignments": Annotated[list[str] | None, option(_SET, True, "--set", metavar="NAME=VALUE")],
    "detector_model": _asked(
        options.DetectorModel,
        "What is averaged over an exposure: line integrals (log) or intensity.",
        "the scan's",
    ),
    "ignore_lag": Annotated[
        bool, option("Leave the lag that the scan file states in the frames.", True, "--ignore-lag")
    ],
    "steps": options.Steps,
    "holdout": _asked(
        float, "Pixels that the method does not see, to say how far its volume is from them.", "0", metavar="PERCENT"
    ),
    "tune": _asked(str, _TUNE, "none", metavar="NAME[=VALUES]"),
    "median_filter": _asked(int, "Median filter of the frames: 3 or 5 pixels per side, 0 none.", "0"),
    "device": options.Device,
    "memory": options.Memory,
}


@dataclass(frozen=True)
class RunRequest:
    """What the options of a reconstruction were given; ``given`` has None for those that were not."""

    config: Path | None
    assignments: list[str]
    given: dict[str, Any]

    def settings(self) -> RunSettings:
        """Everything together, checked; InputError for an option or line that is not what it should be."""
        return run_settings(self.config, self.given, self.assignments)

    def job(self, settings: RunSettings, scan: Path, output: Path, **more: Any) -> ReconstructionJob:
        """What is to be done with ``scan``, by the ``settings`` of this request."""
        known = {name: getattr(settings, name) for name in ("method", "seed", "preset", "changes", "before")}
        return ReconstructionJob(scan, output, config=self.config, **known, **more)


def with_run_options(*without: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Gives a command all options of a reconstruction but some, in place of its parameter ``request``: Typer, which
    reads a command's signature, sees the options, and the command is called with a RunRequest."""
    names = [name for name in RUN_OPTIONS if name not in without]

    def decorated(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def called(**values: Any) -> None:
            found = {name: values.pop(name) for name in names}
            given = {name: None if value is False else value for name, value in found.items()}  # a flag not raised
            config, assignments = given.pop("config"), given.pop("assignments") or []
            command(request=RunRequest(config, assignments, given), **values)

        called.__signature__ = _signature(command, names)  # type: ignore[attr-defined]
        return called

    return decorated


def _signature(command: Callable[..., None], names: list[str]) -> inspect.Signature:
    """The command's own, with the options of a reconstruction for ``request``."""
    parameters: list[inspect.Parameter] = []
    for own in inspect.signature(command, eval_str=True).parameters.values():
        if own.name == "request":
            for name in names:
                default = False if get_args(kind := RUN_OPTIONS[name])[0] is bool else None
                parameters.append(inspect.Parameter(name, own.KEYWORD_ONLY, default=default, annotation=kind))
        else:
            parameters.append(own.replace(kind=own.KEYWORD_ONLY))
    return inspect.Signature(parameters)
