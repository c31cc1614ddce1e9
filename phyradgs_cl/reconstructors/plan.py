"""A run as one value: method, options by name, preprocessing, seed, first volume, and how the object moves. The command
line, configuration files, the API and sweeps all make it with ``plan_run``."""

import hashlib
import logging
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.acquisition.motion import MODELS, MOTIONS, RAYS, SPLATS, motions_for
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, triple
from phyradgs_cl.reconstructors.method import DEFAULT_METHOD, METHODS, check_able, method_name, method_of
from phyradgs_cl.reconstructors.preprocess import Preprocessing
from phyradgs_cl.reconstructors.result import option_facts
from phyradgs_cl.removed import refuse_removed
from phyradgs_cl.text import flag_of, suggest_name

_COUNTS = tuple(dict.fromkeys(f.name for model in MODELS for f in fields(model) if f.init))
"""Names of motion models' fields, such as the number of times per line, which are also names of options."""
_ALL = motions_for(RAYS, SPLATS)  # a user's own method may take any motion model
LARGEST_SEED = 2**63
_DECIMALS = 6  # a run's identity rounds mm and s to this many decimals, so that it stays when a scan is stored and read
_SUBJECT = "--object-motion"
_MOST_VOXELS = 24  # most voxels along a side of the grid on which a deformation is checked; deformations are smooth
_LEAST_DETERMINANT = 0.05  # a deformation w(y) with a smaller det(I + ∂w/∂y) is refused: at 0 matter folds
_LEAST_COVERED = 0.5  # a deformation that covers less than this fraction of the scan's time is refused
_MOSTLY_COVERED = 0.98  # a deformation that covers less than this fraction of the scan's time causes a warning
log = logging.getLogger(__name__)


def method_options(method: object, preset: str | None = None, changes: Mapping[str, Any] | None = None) -> Any:
    """Returns the options of a method: a preset with ``changes`` by field name; changes of nested options are tables.

    ``motion``, ``strips``, ``sub_intervals``, ``segments`` and ``time_error`` change the motion model together; ``motion``
    may be the user's own model. Raises InputError for a name that the method lacks, so that no option is ignored."""
    return changed_options(method, preset_of(method, preset), changes or {})


def preset_of(method: object, preset: str | None = None) -> Any:
    """Returns the options of a method's preset, the first one by default. Raises InputError for a preset that it lacks."""
    name, presets = method_name(method), method_of(method).presets
    chosen = next(iter(presets)) if preset is None else preset
    if not isinstance(chosen, str) or chosen not in presets:
        refuse_removed(f"--preset {chosen}")
        having = [other for other, one in METHODS.items() if isinstance(chosen, str) and chosen in one.presets]
        remedy = f"--method {' or '.join(having)} has it" if having else ""
        raise InputError("--preset", checks.short_repr(chosen), f"one of {', '.join(presets)} for --method {name}", remedy)
    return presets[chosen]


def changed_options(method: object, base: Any, given: Mapping[str, Any]) -> Any:
    """Returns the options ``base`` of a method with the changes ``given`` by field name. See ``method_options``."""
    name, changes = method_name(method), dict(given)
    if hasattr(base, "motion"):
        motion = changes.pop("motion", None)
        counts = {key: value for key in _COUNTS if (value := changes.pop(key, None)) is not None}
        base = replace(base, motion=_motion(name, base, motion, counts))
    return _changed(base, changes, f"--method {name}")


def preprocessing_of(changes: Mapping[str, Any]) -> Preprocessing:
    """Returns the default preprocessing with ``changes`` by field name. Raises InputError for an unknown name or value."""
    return _changed(Preprocessing(), changes, "reconstruct")


def _models(options: Any) -> dict[str, Any]:
    """Returns by name the motion models that ``options`` allow; the model that is set in ``options`` with its settings."""
    own = [options.motion] if hasattr(options.motion, "name") else []
    return {model.name: model for model in (*getattr(options, "MOTIONS", _ALL), *own)}


def _has(model: Any, count: str) -> bool:
    return any(f.name == count and f.init for f in fields(model))


def _motion(method: str, options: Any, motion: Any, counts: dict[str, Any]) -> Motion:
    """Returns the motion model named ``motion``, with the numbers of strips and times in ``counts``; ``motion`` itself if it
    is the user's own model. Raises InputError for an unknown name, and for numbers that the model lacks."""
    if callable(getattr(motion, "cells", None)) and not counts:
        return motion
    models = _models(options)
    if motion is None and not hasattr(options.motion, "name"):
        return options.motion
    name = _implied_motion(options.motion.name, counts, models) if motion is None else motion
    if not isinstance(name, str) or name not in models:
        hidden = {*MOTIONS} - {one.name for one in MODELS if one.poses}  # models that the command line does not take
        named = [one for one in models if one not in hidden]
        raise InputError("--motion", checks.short_repr(name), f"one of {', '.join(named)} for --method {method}")
    model = models[name]
    for key, value in counts.items():
        option = flag_of(key)
        if not _has(model, key):
            having = " or ".join(n for n, other in models.items() if _has(other, key))
            found = f"--motion {name} for --method {method}"
            expected = f"--motion {having}" if having else "a method with a motion that has them"
            raise InputError(option, found, expected, f"leave {option} out")
        model = replace(model, **{key: _converted(getattr(model, key), value, option)})
    return model


def _implied_motion(usual: str, counts: Mapping[str, Any], models: Mapping[str, Any]) -> str:
    """Returns the name of the model that takes the numbers of strips and times in ``counts``: ``usual`` if it does, else the
    only model that does, else ``usual``. A static ``usual`` is always returned: only an explicit ``motion`` replaces it."""
    if usual.startswith("static") or all(_has(models[usual], key) for key in counts):
        return usual
    having = [name for name, m in models.items() if m.is_implied and all(_has(m, key) for key in counts)]
    return having[0] if len(having) == 1 else usual


def _motion_options(options: Any) -> list[str]:
    if not hasattr(options, "motion"):
        return []
    return ["motion", *(key for key in _COUNTS if any(_has(m, key) for m in _models(options).values()))]


def _changed(options: Any, changes: Mapping[str, Any], subject: str) -> Any:
    """Returns ``options`` with ``changes`` by field name. subject: what the InputError for a wrong name or value names."""
    known = {f.name: getattr(options, f.name) for f in fields(options) if f.name != "motion"}
    values: dict[str, Any] = {}
    for key, value in changes.items():
        if key not in known:
            place = f"{subject}: option {key}"
            refuse_removed(place.split(": option ", 1)[1].replace(": option ", "."), place)
            refuse_removed(place)
            names = [*known, *_motion_options(options)]
            remedy = suggest_name(key, names, _having(key) or "leave it out")
            raise InputError(place, "no such option", ", ".join(names), remedy)
        is_function = callable(value) and key in getattr(options, "FUNCTIONS", ())
        values[key] = value if is_function else _converted(known[key], value, f"{subject}: option {key}")
    try:
        return replace(options, **values)
    except (TypeError, ValueError) as error:  # options of a user's method have their own checks
        raise InputError(subject, str(error), "values that its options take") from error


def _having(option: str) -> str:
    """Returns the advice to use a method that has ``option``; "" if none has it."""
    usual = {name: next(iter(one.presets.values())) for name, one in METHODS.items()}
    having = [name for name, options in usual.items() if option in (f.name for f in fields(options))]
    return f"--method {' or '.join(having)} has it" if having else ""


def _converted(current: Any, value: Any, subject: str) -> Any:
    """Returns ``value`` in the type of ``current``: number, word, tuple or nested table. Raises InputError about ``subject``
    for a value that does not fit. A ``current`` of None or of another type accepts every value."""
    if current is None:  # the option's type is unknown: its dataclass checks the value
        return value.item() if isinstance(value, np.generic) else value
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if is_dataclass(current):
        if not isinstance(value, Mapping):
            raise InputError(subject, checks.short_repr(value), "a table")
        return _changed(current, value, subject)
    if isinstance(current, tuple):
        if not isinstance(value, (list, tuple)) or len(value) != len(current):
            raise InputError(subject, checks.short_repr(value), f"a list of {len(current)} numbers")
        return tuple(_converted(c, v, subject) for c, v in zip(current, value, strict=True))
    if type(current) not in _EXPECTED:  # a type that only a user's own options have: their dataclass must check the value
        return value
    expected, fits = _EXPECTED[type(current)]
    if not fits(value):
        raise InputError(subject, checks.short_repr(value), expected)
    return type(current)(value)


def _is_number(value: Any) -> bool:
    """Returns whether ``value`` is a finite number that a float can hold."""
    return checks.is_number(value) and abs(value) <= sys.float_info.max


_EXPECTED: dict[type, tuple[str, Callable[[Any], bool]]] = {
    bool: ("true or false", lambda value: isinstance(value, bool)),
    str: ("a word", lambda value: isinstance(value, str)),
    int: ("a whole number", lambda value: _is_number(value) and value == int(value)),
    float: ("a finite number", _is_number),
}


@dataclass(frozen=True, eq=False)
class InitialVolume:
    """A volume (nz, ny, nx) in 1/mm from which a method starts, and its grid. facts: the file from which the volume came."""

    values: np.ndarray
    grid: Grid
    facts: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """How the object moves during the scan. facts: the file from which ``deformation`` came."""

    deformation: Deformation
    facts: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RunPlan:
    """What to run on a scan. method: a name as ``method_name`` returns it, or the user's own function. options: the method's
    options, checked. preprocessing: changes of the frames before the method.

    Raises InputError for a seed out of range, for an object that moves with a method for objects at rest, and for error bars
    with a first volume or with 0 iterations, because their runs would not differ as they should."""

    method: "str | Callable[..., Any]"
    options: Any
    preprocessing: Preprocessing = Preprocessing()
    seed: int = 0
    initial: InitialVolume | None = None
    object_motion: ObjectMotion | None = None

    def __post_init__(self) -> None:
        checks.whole("--seed", self.seed, 0, LARGEST_SEED)
        object.__setattr__(self, "seed", int(self.seed))
        if self.object_motion is not None:
            check_able("--object-motion", self.method, "takes_deformation", "a method whose object may move")
        if not self.preprocessing.doubt:
            return
        if self.initial is not None:
            found, remedy = "a first volume, whose errors all runs would share", "leave --doubt or --initial out"
            raise InputError("--doubt", found, "runs that start without one", remedy)
        if getattr(self.options, "iterations", 1) == 0:
            expected, remedy = "iterations, in which the runs come to differ", "leave --doubt out, or raise --iterations"
            raise InputError("--doubt", "--iterations 0", expected, remedy)

    @property
    def method_name(self) -> str:
        """The method's name; ``module:name`` for a user's function."""
        return method_name(self.method)

    def identity(self, scan: Scan) -> dict[str, Any]:
        """Returns everything that a run must share with the interrupted run that it continues. Reads all frames."""
        grid, moves = scan.grid, {}
        if self.object_motion is not None:
            one = self.object_motion.deformation
            place = np.array([one.origin_mm, one.spacing_mm])
            moves["object_motion"] = _digest(one.control_mm, place, one.times_s, one.weights)
        return {
            "scan": _digest(scan.projections, np.packbits(scan.valid), *_geometry(scan)),
            "grid": [grid.shape, *(np.round(three, _DECIMALS).tolist() for three in (grid.voxel_size_mm, grid.offset_mm))],
            "method": self.method_name,
            "seed": self.seed,
            "input": self.preprocessing.facts(),
            **option_facts(self.options),
            "initial": None if self.initial is None else _digest(self.initial.values.astype(np.float32)),
            **moves,
        }


def _geometry(scan: Scan) -> Iterator[np.ndarray]:
    """Yields the times at which frames start, then each frame's poses at the start and the end of its span, all rounded."""
    yield np.round(scan.frame_start_s, _DECIMALS)
    span_s = np.array([0.0, scan.shutter.span_s])
    for frame, start_s in enumerate(scan.frame_start_s):
        yield np.round(scan.trajectory.pose(frame, start_s + span_s), _DECIMALS) + 0.0  # adding 0.0 turns -0 into 0


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:16]


def plan_run(
    method: object = DEFAULT_METHOD, values: Mapping[str, Any] | None = None, *, preset: str | None = None,
    seed: int = 0, initial: InitialVolume | None = None, object_motion: ObjectMotion | None = None,
    of_preprocessing: Collection[str] = (),
) -> RunPlan:
    """Returns the plan of a run. values: options of the method, which change its ``preset``, and of the preprocessing.

    A name that both have is taken as the method's option, unless ``of_preprocessing`` contains it. Raises InputError for an
    unknown method, preset or option, and for a value that an option does not take."""
    own, base = dict(values or {}), preset_of(method, preset)
    names = [f.name for f in fields(Preprocessing) if f.name in of_preprocessing or not hasattr(base, f.name)]
    preprocessing = preprocessing_of({name: own.pop(name) for name in names if name in own})
    options = changed_options(method, base, own)
    named = method if callable(method) else method_name(method)
    return RunPlan(named, options, preprocessing, seed, initial, object_motion)


def check_object_motion(deformation: Deformation, scan: Scan) -> None:
    """Raises InputError for a deformation whose position, times or unit do not fit the scan, and for one that folds matter
    or compresses it to nothing. Logs a warning if its times leave out part of the scan."""
    _check_times(deformation, scan)
    grid = scan.grid.in_shape(triple(min(n, _MOST_VOXELS) for n in scan.grid.shape))
    if not deformation.control_mm.any():
        return
    fields_mm = np.stack([deformation.on_grid_mm(grid, unit) for unit in np.eye(deformation.rank)])
    lengths_mm = np.linalg.norm(fields_mm, axis=-1).max(axis=(1, 2, 3))
    reach_mm = float((np.abs(deformation.weights).max(axis=0) * lengths_mm).sum())
    if reach_mm == 0:
        box_mm = np.round(scan.grid.box_mm, 3).tolist()
        remedy = "check the origin and the unit of its control points"
        found = "a deformation that moves nothing in the scan's grid"
        raise InputError(_SUBJECT, found, f"one in {box_mm} mm (z, y, x)", remedy)
    if reach_mm > max(scan.grid.size_mm):
        found = f"displacements of up to {reach_mm:.3g} mm in a box of {max(scan.grid.size_mm):.3g} mm"
        raise InputError(_SUBJECT, found, "displacements within the box", "check the unit of its control vectors")
    if (determinant := deformation.smallest_determinant(grid)) < _LEAST_DETERMINANT:
        found = f"matter that folds: a smallest determinant of {determinant:.3g}"
        raise InputError(_SUBJECT, found, f"at least {_LEAST_DETERMINANT:g}", "use a smoother or smaller field")


def _check_times(deformation: Deformation, scan: Scan) -> None:
    times_s = deformation.times_s
    if len(times_s) == 1:
        return
    first_s, last_s = float(scan.frame_start_s.min()), float(scan.frame_start_s.max() + scan.shutter.span_s)
    covered_s = min(times_s[-1], last_s) - max(times_s[0], first_s)
    found = f"times from {times_s[0]:.4g} to {times_s[-1]:.4g} s for a scan from {first_s:.4g} to {last_s:.4g} s"
    if covered_s < _LEAST_COVERED * (last_s - first_s):
        raise InputError(_SUBJECT, found, "times that cover the scan", "check their unit and where they begin")
    if covered_s < _MOSTLY_COVERED * (last_s - first_s):
        log.warning("%s: found %s; the object rests before and after them, displaced as at their ends", _SUBJECT, found)
