"""Motion models: each gives the poses from which the lines of a frame are projected, and their weights.

A model is a frozen class with ``cells(scan, frame)``, which returns ``TimeCells``: poses with the lines that each serves.
User-defined classes work in every method (docs/methods.md). In a stop-and-shoot scan each model gives one pose per frame."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from typing import Any, ClassVar, Protocol

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import cells
from phyradgs_cl.acquisition.cells import common_time_cells
from phyradgs_cl.acquisition.geometry import POSE_LENGTH
from phyradgs_cl.acquisition.scan import Scan
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.time_cells import TimeCells
from phyradgs_cl.acquisition.trajectory import Trajectory, body_frames
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation

RAYS, SPLATS, LINE_POSES = "rays", "splats", "one pose per line"
"""The kinds of operator that a model may suit: projectors of voxels, of Gaussians, and filtered backprojection."""
_USUAL_TIMES = 6  # most times of an exposure for ``PerRow``, unless rim or object moves over _COARSE_STEP_VOXELS between two
_MOST_TIMES = 100  # most times of an exposure for ``PerRow``, however fast the motion
_FINE_STEP_VOXELS = 0.3  # most voxels that the volume's rim moves between two times of ``PerRow``, if six times suffice
_OBJECT_STEP_VOXELS = 0.7  # most voxels that an object's fastest part moves between two times, if six times suffice
_COARSE_STEP_VOXELS = 3.6  # most voxels that rim or object moves between two times of ``PerRow``, if 100 times suffice
_SUB_INTERVALS = "Sub-intervals N of an exposure; for phyradgs means micro-views."
_WEIGHT_TOLERANCE = 1e-3  # largest |(sum of a line's weights) − 1| that is accepted from a user-defined model


class Motion(Protocol):
    """The interface of a motion model. A result's provenance lists the model's ``name``, if it has one, and its fields."""
    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """Returns the time cells of one frame. The weights of every line sum to 1."""


def rim_travel_voxels(scan: Scan) -> float:
    """Returns how far the grid's rim moves, relative to the panel, during a line's exposure, in voxel sides along y or x.

    The middles of the grid's four sides around the axis stand for the rim. On a circular orbit they move by about r Δθ, for
    a radius r and an arc Δθ. The largest travel in the first, middle and last frame counts. For a gantry at rest it is 0."""
    if not scan.is_fly:
        return 0.0
    half_x_mm, half_y_mm = scan.grid.size_mm[2] / 2, scan.grid.size_mm[1] / 2
    sides_mm = [(half_x_mm, 0, 0), (-half_x_mm, 0, 0), (0, half_y_mm, 0), (0, -half_y_mm, 0)]
    rim_mm = np.array(sides_mm) + scan.grid.offset_mm[::-1]
    frames = {0, scan.frames // 2, scan.frames - 1}
    return max(_travel_mm(scan, frame, rim_mm) for frame in frames) / min(scan.grid.voxel_size_mm[1:])


def _travel_mm(scan: Scan, frame: int, points_mm: np.ndarray) -> float:
    """Returns the largest travel in mm of points (P, 3), relative to the panel, while a frame's first line is exposed."""
    start_s = float(scan.frame_start_s[frame])
    pose = scan.trajectory.pose(frame, np.array([start_s, start_s + scan.shutter.exposure_s]))
    places = np.einsum("tpk,tkl->tpl", points_mm - pose[:, None, 3:6], body_frames(pose))
    return float(np.linalg.norm(places[1] - places[0], axis=-1).max())


def _place(scan: Scan, frame: int) -> tuple[Trajectory, Shutter, int, float, int]:
    return scan.trajectory, scan.shutter, frame, float(scan.frame_start_s[frame]), scan.lines


class _Model(checks.Checked):
    """Base of this module's motion models, with words for help texts and reports."""

    operators: ClassVar[tuple[str, ...]]  # which methods take the model: some of RAYS, SPLATS, LINE_POSES
    poses: ClassVar[str] = ""  # a frame's poses in words, for the help of --motion; "" hides the model from the command line
    counts: ClassVar[str] = ""  # format string of the model's fields, whose text is appended to its name in reports
    is_implied: ClassVar[bool] = True  # whether an option for one of the model's numbers, as --strips, chooses the model


@dataclass(frozen=True)
class Static(_Model):
    """One pose per frame, in the middle between its first and its last light. This model ignores the gantry's motion."""

    poses: ClassVar = "one"
    operators: ClassVar = (RAYS, SPLATS, LINE_POSES)
    name: str = field(default="static", init=False, repr=False)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """Returns the ``TimeCells`` of one frame: one cell, in the middle between first and last light."""
        return cells.static_cells(*_place(scan, frame))


@dataclass(frozen=True)
class StaticStart(_Model):
    """One pose per frame, at its first light. Compared with ``static``, the volume is rotated by half of the arc that the
    gantry turns from a frame's first light to its last."""

    operators: ClassVar = (RAYS, SPLATS, LINE_POSES)
    name: str = field(default="static-start", init=False, repr=False)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """Returns the ``TimeCells`` of one frame: one cell, at first light."""
        first_s = float(scan.frame_start_s[frame]) + scan.shutter.lit_span_s[0]
        return cells.single_cell(scan.trajectory, scan.shutter, frame, first_s, scan.lines)


@dataclass(frozen=True)
class MicroViews(_Model):
    """M × N poses per frame: N ``sub_intervals`` of the exposure of each of M ``strips`` of lines (paper, Eq. 2).

    Raises InputError for numbers below 1."""

    poses: ClassVar = "M×N"
    counts: ClassVar = " {strips} × {sub_intervals}"
    operators: ClassVar = (RAYS, SPLATS)
    name: str = field(default="micro-views", init=False, repr=False)
    strips: int = checks.option(8, "Strips M of a frame; means micro-views.", "8", range=(1, 10_000))
    sub_intervals: int = checks.option(5, _SUB_INTERVALS, "by arc and voxels", range=(1, 10_000))

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """Returns the ``TimeCells`` of one frame: strips × sub-intervals cells."""
        if not scan.is_fly:
            return Static().cells(scan, frame)
        return cells.micro_view_cells(*_place(scan, frame), self.strips, self.sub_intervals)


@dataclass(frozen=True)
class Centres(MicroViews):
    """``MicroViews`` that move only the Gaussians' centres on the panel, as in GS-on-the-Move (the paper's reference 21).

    The shapes and densities of Gaussians on the panel are computed for one pose per frame, the pose of ``Static``.
    ``strips`` and ``sub_intervals`` mean the same as in ``MicroViews``. Raises InputError for numbers below 1."""

    poses: ClassVar = "M×N for centres of splats"
    is_implied: ClassVar = False
    operators: ClassVar = (SPLATS,)  # type: ignore[assignment]
    name: str = field(default="centres", init=False, repr=False)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """Returns the ``TimeCells`` of one frame: strips × sub-intervals cells with one ``conic_pose`` for all of them."""
        if not scan.is_fly:
            return Static().cells(scan, frame)
        return cells.centre_cells(*_place(scan, frame), self.strips, self.sub_intervals)


@dataclass(frozen=True)
class PerRow(_Model):
    """Every line averages over its own exposure, at times that all lines of a frame share.

    ``sub_intervals`` is the number of times in an exposure; 0 takes as many as the scan needs (``of``). Each time stands
    for a cell of the frame's time, weighted for each line by the fraction of its exposure in the cell. Raises InputError for
    a number below 0."""

    poses: ClassVar = "one per line"
    counts: ClassVar = ", times per exposure: {sub_intervals}"
    operators: ClassVar = (RAYS,)
    name: str = field(default="per-row", init=False, repr=False)
    sub_intervals: int = checks.ranged(0, 0, 10_000)

    def of(self, scan: Scan, object_mm_per_s: float = 0.0) -> "PerRow":
        """Returns the model with as many times as the scan needs. A stated number stays. object_mm_per_s: the speed of the
        object's fastest part.

        An exposure has one time per 0.3 voxels that the grid's rim moves, or per 0.7 voxels that the object moves, whichever
        gives more times, but at most 6. Six times suffice for a travel of up to 22 voxels. Longer travel needs one time per
        3.6 voxels, at most 100 times (measured in docs/results/settings.md)."""
        if self.sub_intervals:
            return self
        rim_voxels = rim_travel_voxels(scan)
        object_voxels = object_mm_per_s * scan.shutter.exposure_s / min(scan.grid.voxel_size_mm)
        fine = max(math.ceil(rim_voxels / _FINE_STEP_VOXELS), math.ceil(object_voxels / _OBJECT_STEP_VOXELS))
        coarse = math.ceil(max(rim_voxels, object_voxels) / _COARSE_STEP_VOXELS)
        return replace(self, sub_intervals=min(max(1, min(fine, _USUAL_TIMES), coarse), _MOST_TIMES))

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """Returns the ``TimeCells`` of one frame, from first light to last: cells of length exposure / sub-intervals."""
        if not scan.is_fly:
            return Static().cells(scan, frame)
        where = scan.trajectory, scan.shutter, frame, scan.frame_start_s, scan.lines
        return common_time_cells(*where, self.of(scan).sub_intervals)


@dataclass(frozen=True)
class OwnTimes(_Model):
    """Every line has ``sub_intervals`` poses of its own in its exposure, as in the simulator. ``per-row`` is as exact and
    faster. Raises InputError for a number below 1."""

    operators: ClassVar = (RAYS,)
    name: str = field(default="own-times", init=False, repr=False)
    counts: ClassVar = ", times per line: {sub_intervals}"
    sub_intervals: int = checks.ranged(5, 1, 10_000)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """Returns the ``TimeCells`` of one frame: ``sub_intervals`` cells for every line."""
        if not scan.is_fly:
            return Static().cells(scan, frame)
        return cells.per_line_cells(*_place(scan, frame), self.sub_intervals)


@dataclass(frozen=True)
class LineMiddles(_Model):
    """One pose per line, at the middle of its exposure. This is what ``per-row`` means in filtered backprojection."""

    operators: ClassVar = (LINE_POSES,)
    name: str = field(default="per-row", init=False, repr=False)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """Returns the ``TimeCells`` of one frame: one cell for every line."""
        return OwnTimes(1).cells(scan, frame)


@dataclass(frozen=True)
class Exact(_Model):
    """Gaussians move on the panel during a frame, which is divided into ``segments`` of time. Every line integrates over
    its own exposure.

    With ``segments`` = 0 a frame has as many segments as keep its relative RMS error (dimensionless) below ``time_error``.
    ``time_error`` also limits the error of numerical integration over time. Raises InputError for numbers out of range."""

    poses: ClassVar = "integrals over time, of splats"
    operators: ClassVar = (SPLATS,)
    name: str = field(default="exact", init=False, repr=False)
    segments: int = checks.ranged(0, 0, 1000)
    time_error: float = checks.ranged(0.005, 1e-6, 1)

    def cells(self, scan: Scan, frame: int, intensity_peak: float = 0.0) -> TimeCells:
        """Returns the ``TimeCells`` of one frame, one per segment. intensity_peak: the largest line integral if the detector
        averages intensities, else 0. A peak above 4 needs more segments."""
        if not scan.is_fly:
            return Static().cells(scan, frame)
        where = _place(scan, frame)
        segments = self.segments or cells.segments_for(*where[:4], self.time_error, intensity_peak)
        return cells.exact_cells(*where, segments)


MODELS = (Static, StaticStart, MicroViews, Centres, PerRow, OwnTimes, Exact, LineMiddles)
MOTIONS = tuple(dict.fromkeys(model.name for model in MODELS))
"""The names of the motion models of this package, each once."""


def motions_for(*operators: str) -> tuple[Motion, ...]:
    """Returns the models, with their default numbers, that suit any of ``operators``: some of RAYS, SPLATS, LINE_POSES."""
    return tuple(model() for model in MODELS if set(operators) & set(model.operators))


def motion_of(motion: str | Motion) -> Motion:
    """Returns the motion model of a name, with default numbers, or the given model. Raises InputError for other names."""
    if not isinstance(motion, str):
        return motion
    if motion not in MOTIONS:
        raise InputError("motion", checks.short_repr(motion), f"one of {', '.join(MOTIONS)}")
    return next(model() for model in MODELS if model.name == motion)


def with_times(motion: Motion, scan: Scan, deformation: Deformation | None = None) -> Motion:
    """Returns the motion model. A ``PerRow`` without a stated number of times gets the number that the scan needs.
    deformation: how the object moves; None if it is at rest."""
    speed_mm_per_s = 0.0 if deformation is None else deformation.fastest_mm_per_s
    return motion.of(scan, speed_mm_per_s) if isinstance(motion, PerRow) else motion


def motion_facts(motion: Motion) -> dict[str, object]:
    """Returns a model's name and fields for a result's provenance. Values that JSON cannot hold become their ``repr``."""
    values: dict[str, Any] = asdict(motion) if is_dataclass(motion) and not isinstance(motion, type) else {}
    values = {key: value.item() if isinstance(value, np.generic) else value for key, value in values.items()}
    plain = {key: value if isinstance(value, int | float | str) else repr(value) for key, value in values.items()}
    return {"name": str(getattr(motion, "name", type(motion).__name__)), **plain}


def motion_in_words(facts: Mapping[str, object]) -> str:
    """Returns a model's name and numbers in words, from the result of ``motion_facts``."""
    name = str(facts.get("name"))
    having = [model for model in MODELS if model.name == name and all(f.name in facts for f in fields(model))]
    return name + (having[0].counts.format(**facts) if having else "")


def motion_from_facts(facts: Mapping[str, object]) -> Motion | None:
    """Returns the model from the result of ``motion_facts``, or None for a user-defined model. Raises InputError or
    TypeError for values out of range or of a wrong type."""
    for model in MODELS:
        keys = [f.name for f in fields(model) if f.init]
        if model.name == facts.get("name") and all(key in facts for key in keys):
            return model(**{key: facts[key] for key in keys})  # type: ignore[arg-type]
    return None


def check_motion(motion: Motion, taken: tuple[Motion, ...]) -> None:
    """Raises InputError for anything but a motion model, and for an instance of one of ``MODELS`` if no model in ``taken``
    has its class. A user-defined model is accepted."""
    if isinstance(motion, type) and hasattr(motion, "cells"):
        raise InputError("--motion", f"the class {motion.__name__}", "a model", f"write {motion.__name__}()")
    if not callable(getattr(motion, "cells", None)):
        raise InputError("--motion", checks.short_repr(motion), "a model with cells(scan, frame)")
    if isinstance(motion, MODELS) and type(motion) not in {type(model) for model in taken}:
        raise InputError("--motion", repr(motion), f"one of {', '.join(map(repr, taken))}, or a class of your own")


class MotionOptions(checks.Checked):
    """Base of a method's options: checks that ``motion`` has the class of one in ``MOTIONS``, or a user-defined class."""

    MOTIONS: ClassVar[tuple[Motion, ...]]
    motion: Motion

    def __post_init__(self) -> None:
        super().__post_init__()
        check_motion(self.motion, self.MOTIONS)


def check_own_motion(motion: Motion | None, scan: Scan) -> None:
    """Raises InputError if the cells that a user-defined model returns for the first frame do not fit the scan."""
    if motion is None or isinstance(motion, MODELS):
        return
    subject, table = f"motion {type(motion).__name__}", motion.cells(scan, 0)
    if not isinstance(table, TimeCells):
        raise InputError(subject, f"a {type(table).__name__} from cells(scan, frame)", "TimeCells")
    if (table.lines, table.axis) != (scan.lines, scan.shutter.axis):
        raise InputError(subject, f"cells for {table.lines} {table.axis}", f"{scan.lines} {scan.shutter.axis}")
    checks.shape(f"{subject}: pose", table.pose, (table.count, POSE_LENGTH))
    for name in ("time_s", "line_start", "line_stop"):
        checks.shape(f"{subject}: {name}", getattr(table, name), (table.count,))
    if table.line_share is not None:
        checks.shape(f"{subject}: line_share", table.line_share, (table.count, table.lines))
    weights = table.line_weights()
    worst = float(weights[np.argmax(np.abs(weights - 1))])
    if abs(worst - 1) > _WEIGHT_TOLERANCE:
        found, remedy = f"line weights that sum to {worst:.6g}", "divide them by their sum"
        raise InputError(subject, found, "1 for every line", remedy)
