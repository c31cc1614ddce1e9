"""Motion models: how a reconstruction turns a frame of a scan into time cells.

A model is a frozen class with ``cells(scan, frame)``; one of your own works in every method (docs/methods.md). A scan
that is not a fly-scan has one pose per frame in all of these.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any
from typing import Protocol as Interface

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import cells
from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.acquisition.common_times import common_time_cells
from phyradgs_cl.acquisition.geometry import POSE_LENGTH
from phyradgs_cl.acquisition.scan import Scan
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.trajectory import Trajectory
from phyradgs_cl.errors import InputError

_WHOLE = 1e-3  # how far a line's weights may be from 1, where they are somebody else's


class Motion(Interface):
    """What methods ask of a model. Its ``name``, if it has one, and a dataclass's fields go into the result's facts."""

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """The time cells of one frame, whose line weights sum to 1."""
        ...


def _place(scan: Scan, frame: int) -> tuple[Trajectory, Shutter, int, float, int]:
    return scan.trajectory, scan.shutter, frame, float(scan.frame_start_s[frame]), scan.lines


@dataclass(frozen=True)
class Static:
    """One pose per frame, at the middle of its lit span: a gantry that stands still."""

    name: str = field(default="static", init=False, repr=False)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """The ``TimeCells`` of one frame of a scan: one, at mid-window."""
        return cells.static_cells(*_place(scan, frame))


@dataclass(frozen=True)
class StaticStart:
    """One pose per frame, its first."""

    name: str = field(default="static-start", init=False, repr=False)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """The ``TimeCells`` of one frame of a scan: one, at the frame's opening."""
        return cells.static_start_cells(*_place(scan, frame))


@dataclass(frozen=True)
class MicroViews:
    """M ``strips`` × N ``sub_intervals`` poses per frame, as in the paper. Raises InputError for counts below 1."""

    name: str = field(default="micro-views", init=False, repr=False)
    strips: int = 8
    sub_intervals: int = 5

    def __post_init__(self) -> None:
        checks.whole("strips", self.strips, 1, 10_000)
        checks.whole("sub_intervals", self.sub_intervals, 1, 10_000)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """The ``TimeCells`` of one frame of a scan: strips × sub-intervals of them."""
        if not scan.is_fly:
            return Static().cells(scan, frame)
        return cells.micro_view_cells(*_place(scan, frame), self.strips, self.sub_intervals)


@dataclass(frozen=True)
class PerRow:
    """Every line over its own window, at times that all lines of a frame share: ``sub_intervals`` to an exposure.

    A line weighs each time by the share of its window that lies there. Raises InputError for a count below 1.
    """

    name: str = field(default="per-row", init=False, repr=False)
    sub_intervals: int = 5

    def __post_init__(self) -> None:
        checks.whole("sub_intervals", self.sub_intervals, 1, 10_000)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """The ``TimeCells`` of one frame of a scan: an exposure / sub-intervals each, from first light to last."""
        if not scan.is_fly:
            return Static().cells(scan, frame)
        where = scan.trajectory, scan.shutter, frame, scan.frame_start_s, scan.lines
        return common_time_cells(*where, self.sub_intervals)


@dataclass(frozen=True)
class OwnTimes:
    """Every line at ``sub_intervals`` times of its own exposure, as in the simulator: ``per-row`` is faster and as exact.

    Raises InputError for a count below 1.
    """

    name: str = field(default="own-times", init=False, repr=False)
    sub_intervals: int = 5

    def __post_init__(self) -> None:
        checks.whole("sub_intervals", self.sub_intervals, 1, 10_000)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """The ``TimeCells`` of one frame of a scan: sub-intervals for every line."""
        if not scan.is_fly:
            return Static().cells(scan, frame)
        return cells.per_line_cells(*_place(scan, frame), self.sub_intervals)


@dataclass(frozen=True)
class LineMiddles:
    """Every line at the middle of its own exposure: ``per-row`` of a method that has one pose per line."""

    name: str = field(default="per-row", init=False, repr=False)

    def cells(self, scan: Scan, frame: int) -> TimeCells:
        """The ``TimeCells`` of one frame of a scan: one for every line."""
        return OwnTimes(1).cells(scan, frame)


@dataclass(frozen=True)
class Exact:
    """``segments`` of a frame, in which splats move while every line integrates over its own window.

    0 segments chooses the number so that the error stays below ``time_error`` (dimensionless: a share of a frame's RMS),
    which also bounds the rules that average over time. Raises InputError for numbers out of range.
    """

    name: str = field(default="exact", init=False, repr=False)
    segments: int = 0
    time_error: float = 0.005

    def __post_init__(self) -> None:
        checks.whole("segments (0 chooses from the time error)", self.segments, 0, 1000)
        checks.within("time_error", self.time_error, 1e-6, 1)

    def cells(self, scan: Scan, frame: int, intensity_peak: float = 0.0) -> TimeCells:
        """The ``TimeCells`` of one frame of a scan: its segments. intensity_peak: as for ``segments_for``."""
        if not scan.is_fly:
            return Static().cells(scan, frame)
        where = _place(scan, frame)
        segments = self.segments or cells.segments_for(*where[:4], self.time_error, intensity_peak)
        return cells.exact_cells(*where, segments)


STILL = (Static(), StaticStart(), MicroViews(), PerRow(), OwnTimes())
"""The models whose cells stand still, as they are by themselves."""
MODELS = (Static, StaticStart, MicroViews, PerRow, OwnTimes, Exact, LineMiddles)
MOTIONS = tuple(dict.fromkeys(model.name for model in MODELS))
"""The names of the models."""


def motion_of(motion: str | Motion) -> Motion:
    """A model by its name, as it is by itself; a model as it is."""
    if not isinstance(motion, str):
        return motion
    if motion not in MOTIONS:
        raise InputError("motion", checks.shown(motion), f"one of {', '.join(MOTIONS)}")
    return next(model() for model in MODELS if model.name == motion)


def motion_facts(motion: Motion) -> dict[str, object]:
    """Name and fields of a model, for a result's facts; what JSON has no word for as Python prints it."""
    own: dict[str, Any] = asdict(motion) if is_dataclass(motion) and not isinstance(motion, type) else {}
    own = {key: value.item() if isinstance(value, np.generic) else value for key, value in own.items()}
    plain = {key: value if isinstance(value, int | float | str) else repr(value) for key, value in own.items()}
    return {"name": str(getattr(motion, "name", type(motion).__name__)), **plain}


def motion_from_facts(facts: Mapping[str, object]) -> Motion | None:
    """The inverse of ``motion_facts``; None for a model that is not ours, whose fields are passed over. InputError and
    TypeError for values that a model does not take."""
    name = facts.get("name")
    for model in MODELS:
        own = [f.name for f in fields(model) if f.init]
        if model.name == name and all(key in facts for key in own):
            return model(**{key: facts[key] for key in own})  # type: ignore[arg-type]
    return None


def check_motion(motion: Motion, taken: tuple[Motion, ...]) -> None:
    """InputError unless a model is of a class in ``taken``, or somebody's own."""
    if isinstance(motion, type) and hasattr(motion, "cells"):
        raise InputError("--motion", f"the class {motion.__name__}", "a model", f"write {motion.__name__}()")
    if not callable(getattr(motion, "cells", None)):
        raise InputError("--motion", checks.shown(motion), "a model with cells(scan, frame)")
    if isinstance(motion, MODELS) and type(motion) not in {type(own) for own in taken}:
        raise InputError("--motion", repr(motion), f"one of {', '.join(map(repr, taken))}, or a class of your own")


def check_own_motion(motion: object, scan: Scan) -> None:
    """InputError where a model of somebody's own gives no cells for a scan's first frame, or cells that do not fit its
    lines.
    """
    if motion is None or isinstance(motion, MODELS):
        return
    subject, made = f"motion {type(motion).__name__}", motion.cells(scan, 0)  # type: ignore[attr-defined]
    if not isinstance(made, TimeCells):
        raise InputError(subject, f"a {type(made).__name__} from cells(scan, frame)", "TimeCells")
    if (made.lines, made.axis) != (scan.lines, scan.shutter.axis):
        found, expected = f"cells for {made.lines} {made.axis}", f"{scan.lines} {scan.shutter.axis}"
        raise InputError(subject, found, expected)
    checks.shape(f"{subject}: pose", made.pose, (made.count, POSE_LENGTH))
    for name in ("time_s", "line_start", "line_stop"):
        checks.shape(f"{subject}: {name}", getattr(made, name), (made.count,))
    if made.line_share is not None:
        checks.shape(f"{subject}: line_share", made.line_share, (made.count, made.lines))
    weights = made.line_weights()
    worst = float(weights[np.argmax(np.abs(weights - 1))])
    if abs(worst - 1) > _WHOLE:
        raise InputError(subject, f"line weights that sum to {worst:.6g}", "1 for every line", "divide them by their sum")
