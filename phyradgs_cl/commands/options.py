"""Options that several commands share, such as those of a reconstruction, and the parsers of their values."""

import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from phyradgs_cl.acquisition import MOTIONS
from phyradgs_cl.acquisition.readout import SIDES
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.commands.console import file_argument, file_option, numbers, option, pair_of
from phyradgs_cl.prepare import DEFAULT_STEPS, STEPS
from phyradgs_cl.reconstructors import DEFAULT_METHOD, METHODS
from phyradgs_cl.reconstructors.voxels.priors import PRIORS
from phyradgs_cl.removed import REMOVED
from phyradgs_cl.runtime import DEVICE_VARIABLE, MEMORY_VARIABLE
from phyradgs_cl.settings import Settings, read_settings

LARGEST_MM = 1e6  # largest size of lengths in mm that an option takes
First = Literal[SIDES]  # type: ignore[valid-type]
DetectorModel = Literal[DETECTOR_MODELS]  # type: ignore[valid-type]

Scan = Annotated[Path, file_argument("SCAN", "Scan file (HDF5, NXtomo).")]
Output = Annotated[Path, file_option("File to write; an existing one is replaced.", "--output", "-o")]
_DEVICE = f"Index, cpu, gpu or part of a name (phyradgs devices); a list with commas for ranks. Also ${DEVICE_VARIABLE}."
Device = Annotated[str | None, option(_DEVICE, "best by capability")]
_MEMORY = f"Limit of device memory, such as 2GiB; larger volumes are cut into bricks (large.md). Also ${MEMORY_VARIABLE}."
Memory = Annotated[str | None, option(_MEMORY, "what the device has", metavar="SIZE")]

_OBJECT_MOTION = "Deformation file, or simulated scan, with the motion of the object during the scan (docs: moving.md)."
ObjectMotion = Annotated[Path | None, file_option(_OBJECT_MOTION, "--object-motion")]

IgnoreLag = Annotated[bool, option("Leave the scan's lag in the frames.", True, "--ignore-lag")]
_CHECKPOINT = "Seconds from checkpoint to checkpoint of a run, which continues from its last; 0: on Ctrl-C only."
CheckpointEvery = Annotated[float, option(_CHECKPOINT, metavar="SECONDS")]
CHECKPOINT_EVERY_S = 600.0  # default time between checkpoints

_STEPS = f"Corrections of the frames, of {', '.join(STEPS)} (docs: prepare.md)."
STEPS_OF_PREPARE = option(_STEPS, DEFAULT_STEPS, metavar="NAME,...")
Steps = Annotated[str | None, option(_STEPS, "none", metavar="NAME,...")]


def lengths(flag: str, help: str, default: str) -> Any:
    """Returns an option that takes two lengths V,U in mm."""
    return option(help, default, flag, parser=pair_of(flag, "V,U in mm", "0,12.5", LARGEST_MM), metavar="V,U")


def pitches(flag: str, help: str, default: str) -> Any:
    """Returns an option that takes the pitches V,U of a pixel in mm, or one number for square pixels."""
    pair = pair_of(flag, "V,U in mm, or one for square pixels", "0.148 or 0.3,0.15", LARGEST_MM)
    return option(help, default, flag, parser=lambda text: pair(text if "," in text else f"{text},{text}"), metavar="D|V,U")


def _asked(kind: Any, help: str, default: str, *flags: str, **more: Any) -> Any:
    return Annotated[kind | None, option(help, default, *flags, **more)]


def _numbers(help: str, metavar: str, *flags: str, default: str = "the scan's") -> Any:
    """Returns an option of numbers with commas between, which are checked where they are used."""
    return Annotated[Any, option(help, default, *flags, parser=numbers, metavar=metavar)]


Size = _numbers("Voxels of the volume; a single number: along its longest side. The box stays.", "N|Z,Y,X")
VoxelMm = _numbers("Sides of a voxel, mm; the box stays.", "D|Z,Y,X")
_ROI = "Box of the volume about the axis, mm, or its sides about the scan's middle; the voxels stay."
RoiMm = _numbers(_ROI, "D|Z,Y,X|Z0,Z1,Y0,Y1,X0,X1", "--roi-mm", "--roi")
_MARGIN = "Width around the box, mm, that is reconstructed and discarded: for objects larger than box or panel."

# Names of parameters by heading of the help. A command shows those that it has.
RUN_GROUPS = {
    "Basics": ("output", "method", "motion", "size", "iterations"),
    "Volume": ("voxel_mm", "roi_mm", "margin_mm", "initial", "mu_water_per_mm", "rows", "slab"),
    "Motion": ("object_motion", "strips", "sub_intervals", "segments", "time_error", "detector_model"),
    "Quality": (
        *("prior", "preset", "assignments", "holdout", "doubt", "steps", "ignore_lag", "gaussians", "seed"),
    ),
    "Run": ("device", "memory", "config", "preview", "live", "resume", "checkpoint_every", "profile"),
    "Under mpiexec (docs: cluster.md)": ("batch",),
}
_METHOD = "fdk: analytic; phyradgs, r2: splats; naf, sax-nerf: neural fields; the others: voxels (docs: methods.md)."
_MOTION = (
    "Every method takes the scan's motion; static ignores it. Poses of a frame: one (static), M×N micro-views, one per "
    "line (per-row), or, for splats, integrals over time (exact), or M×N that move only centres (centres)."
)
_MOTIONS = tuple(name for name in MOTIONS if f"--motion {name}" not in REMOVED)
_PRIORS = ", ".join(PRIORS).replace("piccs", "piccs (with --initial)")
_PRIOR = (
    f"Prior, for fista: {' or '.join(_PRIORS.rsplit(', ', 1))}; MODULE:NAME: a denoiser of your own, a tenth of its change "
    "at 50 × the noise that it is given (docs: methods.md)."
)
_PRESET = "Constants: default, quick, paper (phyradgs); published (r2, naf, sax-nerf); a window (fdk)."
_CONFIG = "TOML file of options, with underscores for dashes (docs: formats.md); the command line wins."
_SET = "An option of the method by name: --set tv_weight=0.002 (docs: methods.md)."
_DOUBT = "Run twice more, for an error bar of every voxel: dataset doubt of the volume file (docs: methods.md)."
_HOLDOUT = "Pixels hidden from the method, to measure its error on them."
RUN_OPTIONS: dict[str, Any] = {
    "method": _asked(str, _METHOD, DEFAULT_METHOD, metavar=f"{'|'.join(METHODS)}|MODULE:NAME"),
    "motion": _asked(Literal[_MOTIONS], _MOTION, "per-row"),
    "strips": _asked(int, "Strips M of a frame; means micro-views.", "8"),
    "sub_intervals": _asked(int, "Sub-intervals N of an exposure; for phyradgs means micro-views.", "by arc and voxels"),
    "segments": _asked(int, "Segments of a frame (exact); 0: by --time-error.", "0"),
    "time_error": _asked(float, "Relative error of averaging over time (exact).", "0.005"),
    "iterations": _asked(int, "Iterations: of voxels all frames each, of splats one frame (then 3000).", "35"),
    "prior": _asked(str, _PRIOR, "ridge", metavar="NAME|MODULE:NAME"),
    "gaussians": _asked(int, "Gaussians at the start, for splats.", "from the grid"),
    "size": Size,
    "voxel_mm": VoxelMm,
    "roi_mm": RoiMm,
    "margin_mm": _numbers(_MARGIN, "D|Z,Y,X", default="0"),
    "seed": _asked(int, "Seed of the random numbers.", "0"),
    "preset": _asked(str, _PRESET, "the method's first"),
    "batch": _asked(int, "Frames per step, for splats.", "as many as ranks", metavar="B"),
    "config": Annotated[Path | None, file_option(_CONFIG, "--config")],
    "assignments": Annotated[list[str] | None, option(_SET, True, "--set", metavar="NAME=VALUE")],
    "detector_model": _asked(DetectorModel, "An exposure averages line integrals (log) or intensity.", "the scan's"),
    "ignore_lag": IgnoreLag,
    "steps": Steps,
    "holdout": _asked(float, _HOLDOUT, "0", metavar="PERCENT"),
    "doubt": Annotated[bool, option(_DOUBT, True, "--doubt")],
    "device": Device,
    "memory": Memory,
}


def with_run_options(*without: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that gives a command the options of a reconstruction, except ``without``, in place of its
    parameter ``settings``."""

    def settings(options: dict[str, Any]) -> Settings:
        given = {name: None if value is False else value for name, value in options.items()}  # False: a flag not given
        config, assignments = given.pop("config"), given.pop("assignments") or []
        return read_settings(config, given, assignments)

    kinds = {name: kind for name, kind in RUN_OPTIONS.items() if name not in without}
    options = {name: (kind, False if get_args(kind)[0] is bool else None) for name, kind in kinds.items()}
    return with_options("settings", options, settings)


def with_options(
    slot: str, options: Mapping[str, tuple[Any, Any]], make: Callable[[dict[str, Any]], Any]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that gives a command ``options``, each (annotation, default), in place of its parameter ``slot``.
    Typer reads a command's signature, so the signature lists them. The command gets ``make(values by name)``."""

    def decorated(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def called(**values: Any) -> Any:
            return command(**{slot: make({name: values.pop(name) for name in options})}, **values)

        own = inspect.signature(command, eval_str=True).parameters.values()
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters = [one.replace(kind=keyword) for one in own if one.name != slot]
        place = [one.name for one in own].index(slot)
        parameters[place:place] = [
            inspect.Parameter(name, keyword, default=default, annotation=kind) for name, (kind, default) in options.items()
        ]
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        return called

    return decorated
