"""The options of a reconstruction, given to every command that speaks of one."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from phyradgs_cl.commands import options
from phyradgs_cl.settings import RunSettings, run_settings

RUN_OPTIONS: dict[str, Any] = {
    "method": options.Method,
    "motion": options.MotionModel,
    "strips": options.Strips,
    "sub_intervals": options.SubIntervals,
    "segments": options.Segments,
    "time_error": options.TimeError,
    "iterations": options.Iterations,
    "gaussians": options.GaussianCount,
    "size": options.Size,
    "voxel_mm": options.VoxelMm,
    "roi_mm": options.RoiMm,
    "seed": options.Seed,
    "preset": options.Preset,
    "batch": options.Batch,
    "config": options.Config,
    "assignments": options.Assignments,
    "detector_model": options.LineModel,
    "ignore_lag": options.IgnoreLag,
    "median_filter": options.MedianFilter,
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
        """Everything together, checked.

        Raises:
            InputError: an option, or a line of the file, is not what it should be.
        """
        return run_settings(self.config, self.given, self.assignments)


def with_run_options(*without: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Gives a command all options of a reconstruction but some, in the place of its parameter ``request``.

    Typer reads a command's signature: the one that it finds has the options, and the command is called with a RunRequest.
    """
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
            parameters += [_parameter(name) for name in names]
        else:
            parameters.append(own.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    return inspect.Signature(parameters)


def _parameter(name: str) -> inspect.Parameter:
    annotation = RUN_OPTIONS[name]
    default = False if get_args(annotation)[0] is bool else None
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
