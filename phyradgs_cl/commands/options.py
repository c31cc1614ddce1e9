"""Options that several commands share, such as a reconstruction's, and how their values are parsed."""

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import Field, fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from phyradgs_cl.acquisition.motion import MODELS
from phyradgs_cl.acquisition.readout import SIDES
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.commands.console import file_argument, file_option, numbers, option, pair_of, pair_option
from phyradgs_cl.fields import GridChoice
from phyradgs_cl.reconstructors import DEFAULT_METHOD, METHODS, Preprocessing
from phyradgs_cl.reconstructors.voxels.priors import PRIORS
from phyradgs_cl.runtime import DEVICE_VARIABLE, MEMORY_VARIABLE
from phyradgs_cl.settings import Settings, device_wish, read_settings
from phyradgs_cl.text import flag_of

LARGEST_MM = 1e6  # no scanner has longer lengths
First = Literal[SIDES]  # type: ignore[valid-type]
DetectorModel = Literal[DETECTOR_MODELS]  # type: ignore[valid-type]

Scan = Annotated[Path, file_argument("SCAN", "Scan file (HDF5, NXtomo).")]
Output = Annotated[Path, file_option("File to write; an existing one is replaced.", "--output", "-o")]
_DEVICE = f"Index, cpu, gpu or part of a name (phyradgs devices); a list with commas for ranks. Also ${DEVICE_VARIABLE}."
Device = Annotated[str | None, option(_DEVICE, "best by capability", parser=device_wish, metavar="TEXT")]
_MEMORY = f"Limit of device memory, such as 2GiB; larger volumes are cut into bricks (large.md). Also ${MEMORY_VARIABLE}."
Memory = Annotated[str | None, option(_MEMORY, "what the device has", metavar="SIZE")]

_OBJECT_MOTION = "Deformation file, or simulated scan, with the motion of the object during the scan (docs: moving.md)."
ObjectMotion = Annotated[Path | None, file_option(_OBJECT_MOTION, "--object-motion")]

_CHECKPOINT = "Seconds from checkpoint to checkpoint of a run, which continues from its last; 0: on Ctrl-C only."
CheckpointEvery = Annotated[float, option(_CHECKPOINT, metavar="SECONDS")]
CHECKPOINT_EVERY_S = 600.0  # a killed run loses at most about this time, of which writing a checkpoint takes a small part


lengths = pair_option("V,U in mm", "0,12.5", "V,U", LARGEST_MM)


def pitches(flag: str, help: str, default: str) -> Any:
    """Returns an option for a pixel's height and width V,U in mm, or one number for square pixels."""
    pair = pair_of(flag, "V,U in mm, or one for square pixels", "0.148 or 0.3,0.15", LARGEST_MM)
    return option(help, default, flag, parser=lambda text: pair(text if "," in text else f"{text},{text}"), metavar="D|V,U")


def _asked(kind: Any, help: str, default: str, *flags: str, **more: Any) -> Any:
    return Annotated[kind | None, option(help, default, *flags, **more)]


def of_fields(kind: type, **makers: Callable[[str, str, Any], Any]) -> dict[str, tuple[Any, Any]]:
    """Returns options of a command, (annotation, default) by name, for those fields of a dataclass that have a help text.
    makers: functions ``(flag, help, usual)`` that return the options of fields with a special parser. All other fields
    whose type is a tuple take numbers with commas between, which are checked later."""
    return {one.name: _of_field(one, makers) for one in fields(kind) if one.metadata.get("help")}


def _of_field(one: Field[Any], makers: Mapping[str, Callable[..., Any]]) -> tuple[Any, Any]:
    known = one.metadata
    help, usual, flags = known["help"], known["usual"], [flag_of(one.name), *([known["flag"]] if "flag" in known else [])]
    default = one.default if usual is True else None
    if one.name in makers:
        return Annotated[Any, makers[one.name](flags[-1], help, usual)], default
    more: dict[str, Any] = {"metavar": known["metavar"]} if "metavar" in known else {}
    kind: Any = Literal[known["words"]] if "words" in known else known.get("kind", one.type)
    if any(get_origin(part) is tuple for part in get_args(kind)):
        return Annotated[Any, option(help, usual, *flags, parser=numbers, **more)], default
    return Annotated[kind if default is not None else kind | None, option(help, usual, *flags, **more)], default


OF_FRAMES = of_fields(Preprocessing)
OF_GRID = of_fields(GridChoice)
_MODELS = [model for model in MODELS if model.poses]
_POSES = ", ".join(f"{model.poses} ({model.name})" for model in _MODELS)
_MOTION = f"Every method takes the scan's motion; static ignores it. Poses of a frame: {_POSES}."
OF_MOTION = {name: kind for model in MODELS for name, (kind, _) in of_fields(model).items()}

_METHOD = "fdk: analytic; phyradgs, r2: splats; naf, sax-nerf: neural fields; the others: voxels (docs: methods.md)."
_PRIORS = ", ".join(PRIORS).replace("piccs", "piccs (with --initial)")
_PRIOR = (
    f"Prior, for fista: {' or '.join(_PRIORS.rsplit(', ', 1))}; MODULE:NAME: a denoiser of your own, a tenth of its change "
    "at 50 × the noise that it is given (docs: methods.md)."
)
OF_METHODS: dict[str, Any] = {
    "prior": _asked(str, _PRIOR, "ridge", metavar="NAME|MODULE:NAME"),
    "gaussians": _asked(int, "Gaussians at the start, for splats.", "from the grid"),
}
_PRESET = "Constants: default, quick, paper (phyradgs); published (r2, naf, sax-nerf); a window (fdk)."
_CONFIG = "TOML file of options, with underscores for dashes (docs: formats.md); the command line wins."
_SET = "An option of the method by name: --set tv_weight=0.002 (docs: methods.md)."
RUN_OPTIONS: dict[str, Any] = {
    "method": _asked(str, _METHOD, DEFAULT_METHOD, metavar=f"{'|'.join(METHODS)}|MODULE:NAME"),
    "motion": _asked(Literal[tuple(model.name for model in _MODELS)], _MOTION, "per-row"),
    **OF_MOTION,
    "iterations": _asked(int, "Iterations: of voxels all frames each, of splats one frame (then 3000).", "26"),
    **OF_METHODS,
    **{name: kind for name, (kind, _) in OF_FRAMES.items()},
    "seed": _asked(int, "Seed of the random numbers.", "0"),
    "preset": _asked(str, _PRESET, "the method's first"),
    "config": Annotated[Path | None, file_option(_CONFIG, "--config")],
    "assignments": Annotated[list[str] | None, option(_SET, True, "--set", metavar="NAME=VALUE")],
    "detector_model": _asked(DetectorModel, "An exposure averages line integrals (log) or intensity.", "the scan's"),
    "device": Device,
    "memory": Memory,
}


def with_run_options(*without: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that replaces a command's parameter ``settings`` by ``RUN_OPTIONS`` other than ``without``."""
    kinds = {name: kind for name, kind in RUN_OPTIONS.items() if name not in without}
    options = {name: (kind, False if get_args(kind)[0] is bool else None) for name, kind in kinds.items()}
    return with_options("settings", options, settings_of)


def settings_of(options: dict[str, Any]) -> Settings:
    """Returns a command's settings from its options. Further settings come from the TOML file ``config`` and from the texts
    NAME=VALUE of ``assignments``."""
    given = {name: None if value is False else value for name, value in options.items()}  # False means "not given"
    config, assignments = given.pop("config"), given.pop("assignments") or []
    return read_settings(config, given, assignments)


def with_options(
    slot: str, options: Mapping[str, tuple[Any, Any]], make: Callable[[dict[str, Any]], Any]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that replaces a command's parameter ``slot`` by ``options``, each (annotation, default).

    The command is called with ``make(values by name)`` for ``slot``. Its signature, which Typer reads, lists the options."""

    def decorated(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def called(**values: Any) -> Any:
            return command(**{slot: make({name: values.pop(name) for name in options})}, **values)

        keyword, parameters = inspect.Parameter.KEYWORD_ONLY, list[inspect.Parameter]()
        for name, one in inspect.signature(command, eval_str=True).parameters.items():
            listed = options.items() if name == slot else [(name, (one.annotation, one.default))]
            parameters += [inspect.Parameter(n, keyword, default=usual, annotation=kind) for n, (kind, usual) in listed]
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        return called

    return decorated
