"""The result of every method, and its progress reports."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition.motion import motion_facts
from phyradgs_cl.errors import InputError, naming_arguments
from phyradgs_cl.fields import Deformation, Gaussians, Grid, Hounsfield, States
from phyradgs_cl.fields.hounsfield import Box, fitted, of_facts
from phyradgs_cl.io.volume import interruption, place_of
from phyradgs_cl.reconstructors.checkpoint import State

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import DataArray

    from phyradgs_cl.acquisition import Scan
    from phyradgs_cl.reconstructors.projected import FramePair
    from phyradgs_cl.runtime import Runtime

VolumeMap = Callable[[np.ndarray, Grid], tuple[np.ndarray, Grid]]
"""A function from a volume and its grid to another volume and grid."""
HELD_OUT = "held_out"
"""Key of a result's facts: the errors on held-out pixels, as ``holdout_errors`` returns them."""
COMPARED = "compared"
"""Key of a result's facts: how the volume was compared with the scan's reference, if not voxel by voxel."""
MOTION_FOUND = "motion_found"
"""Key of a result's facts: what a method has found about the motion of the object."""
MARGIN_MM = "margin_mm"
"""Key of a result's facts: the width (z, y, x) in mm of the margin around the volume, reconstructed and discarded."""
DOUBT = "doubt"
"""Key of a result's facts about its error bars, or about which of the runs for error bars was interrupted."""


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction:
    """A volume (nz, ny, nx) float32 in 1/mm on ``grid``, whose lengths are in mm.

    - gaussians: the Gaussians in mm of a splatting method. record: the convergence record, one dict per line.
    - facts: what is needed to repeat the reconstruction (method, options, scales), and its seconds.
    - state: the arrays from which an interrupted run resumes.
    - deformation: how the object moves, for ``moving``, whose volume is its reference state.
    - states: the object at some times, for ``changing``, whose volume is their mean.
    - doubt: σ (nz, ny, nx) in 1/mm of the volume's errors (docs/methods.md#error-bars).

    Raises InputError for arrays that do not fit the grid."""

    volume: np.ndarray
    grid: Grid
    gaussians: Gaussians | None = None
    record: list[dict[str, float]] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)
    state: State | None = None
    deformation: Deformation | None = None
    states: States | None = None
    doubt: np.ndarray | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.grid, Grid):
            raise InputError("grid", checks.short_repr(self.grid), "a Grid")
        object.__setattr__(self, "volume", checks.real_array("volume", self.volume))
        checks.shape("volume", self.volume, self.grid.shape)
        if self.doubt is not None:
            checks.shape("doubt", checks.real_array("doubt", self.doubt), self.grid.shape)
        if self.states is not None:
            checks.shape("states", self.states.volumes, (None, *self.grid.shape))

    def __repr__(self) -> str:
        voxels, sides = (" × ".join(f"{n:g}" for n in three) for three in (self.grid.shape, self.grid.size_mm))
        of = f" of {self.gaussians.count} Gaussians" if self.gaussians is not None else ""
        way = f", interrupted at {self.interrupted_at}" if self.interrupted_at else self.early_stop
        return f"Reconstruction({self.facts.get('method', 'a volume')}{of}, {voxels} voxels in {sides} mm{way})"

    @property
    def moves(self) -> Deformation | States | None:
        """How the object changes (``states``) or moves (``deformation``), as the method found it; None without both."""
        return self.deformation if self.states is None else self.states

    @property
    def interrupted_at(self) -> str:
        """Where the run was interrupted, as in "iteration 3 of 40"; "" if it was not."""
        return place_of(interruption(self.facts))

    @property
    def early_stop(self) -> str:
        """Why the method ended before its last iteration, as the end of a line; "" if it did not."""
        done, reason = self.facts.get("iterations"), self.facts.get("stopped_by")
        options = self.facts.get("options")
        asked = options.get("iterations") if isinstance(options, Mapping) else None
        if reason in (None, "iterations", "interrupt") or done in (None, asked):
            return ""
        return f", stopped after {done} of {asked} iterations ({reason})"

    def complete(self) -> "Reconstruction":
        """Returns the result. Raises KeyboardInterrupt if the run was interrupted, since the result is then incomplete."""
        if self.facts.get("interrupted_at") is not None:
            raise KeyboardInterrupt
        return self

    def within(self, grid: Grid) -> "Reconstruction":
        """Returns the part of the result on ``grid``, with all Gaussians; the result itself if ``grid`` is no part of its
        grid."""
        if (part := grid.slices_in(self.grid)) is None:
            return self
        of_all = slice(None), *part
        states = self.states and replace(self.states, volumes=self.states.volumes[of_all].copy())
        doubt = None if self.doubt is None else self.doubt[part].copy()
        return replace(self, volume=self.volume[part].copy(), grid=grid, states=states, doubt=doubt)

    @property
    def scale(self) -> Hounsfield | None:
        """The scale of Hounsfield units, if ``hounsfield`` has fitted one or a file has kept one."""
        return of_facts(self.facts)

    @naming_arguments()
    def hounsfield(
        self, air: Box | None = None, water: Box | None = None, insert_hu: float = 0.0
    ) -> "Reconstruction":
        """Returns the result, still in 1/mm, with a scale of Hounsfield units fitted to two points.

        air, water: boxes (z0, z1, y0, y1, x0, x1) in mm, whose mean counts; None: a peak of the volume's histogram, the
        lowest for air, the largest above that for water. insert_hu: the HU of the second point, if it is not water.
        ``result.scale.line`` says what was fitted, ``result.scale.of(result.volume)`` is the volume in HU. ``save_volume``
        keeps the scale.

        Raises InputError for less than 100 voxels, air that is not below water, and peaks that cannot be air and water."""
        scale = fitted(self.volume, self.grid, air, water, insert_hu)
        return replace(self, facts={**self.facts, **scale.facts()})

    @naming_arguments()
    def to_xarray(self, *, hu: bool = False, states: bool = False) -> "DataArray":
        """Returns the volume as xarray's DataArray (z, y, x) with coordinates in mm; nothing is copied.

        hu: in Hounsfield units of ``scale``, a copy, in place of 1/mm. states: the states (time, z, y, x) of a result that
        has them, with times in s.

        Raises InputError for a scale or states that the result does not have, and if xarray is not installed."""
        checks.flag("hu", hu)
        checks.flag("states", states)
        scale, of_times = self.scale, self.states
        if hu and scale is None:
            raise InputError("hu", "a result without a scale", "a scale", "result.hounsfield(air, water) fits one")
        if states and of_times is None:
            raise InputError("states", "a result without states", "one of method changing", "leave it out")
        values = self.volume if not states or of_times is None else of_times.volumes
        if hu and scale is not None:
            values = scale.of(values)
        return self.grid.data_array(values, "HU" if hu else "1/mm", of_times.times_s if states and of_times else None)

    @naming_arguments()
    def plot(self, scan: "Scan | None" = None, *, frame: int = 0, device: "str | Runtime | None" = None) -> "Figure":
        """Returns a figure: the three middle slices in 1/mm with a scale bar in mm, and the convergence if it is recorded.

        scan: the scan of the result. It adds a frame, the frame's residual and, if the scan has a reference (nz, ny, nx) in
        1/mm, this reference and the difference. device: where the volume is projected for the residual.

        Raises InputError if ``scan`` is no Scan or has no such frame."""
        from phyradgs_cl.reconstructors.plot import plot_result

        note = ", without the margin" if MARGIN_MM in self.facts else ""
        return plot_result(self.volume, self.grid, self.record, scan, frame, device, note, self.moves)


def interrupted(partial: Reconstruction | None) -> KeyboardInterrupt:
    """Returns a KeyboardInterrupt whose attribute ``partial`` is the result so far, or None if there is no volume yet.

    It is no subclass: only after KeyboardInterrupt itself does Python end by SIGINT, so that a calling shell stops too."""
    kept = "before there was a volume"
    if partial is not None:
        when = f"after {partial.interrupted_at}" if partial.interrupted_at else "at its end"
        kept = f"{when}; the volume so far is the error's partial"
    error = KeyboardInterrupt(f"interrupted {kept}")
    error.partial = partial  # type: ignore[attr-defined]
    return error


@dataclass(frozen=True)
class Progress:
    """One report of a running method: ``iteration`` of ``iterations`` is finished, after ``seconds`` in s.

    - loss: the dimensionless measure that ``quantity`` names. gaussians: the number of Gaussians, or 0.
    - state returns the state from which the run can resume. volume returns the present volume (nz, ny, nx) in 1/mm and its
      grid. frames returns a given number of measured frames, spread evenly, with those computed from the present volume.
      These three may be called during the report only.
    - deformation: how the object moves, once the method has found it. states: returns the object at some times, if the
      method has them.

    A report that raises KeyboardInterrupt ends the run as Ctrl-C does."""

    iteration: int
    iterations: int
    loss: float
    gaussians: int
    seconds: float
    quantity: str = "loss"
    state: "Callable[[], State] | None" = None
    volume: "Callable[[], tuple[np.ndarray, Grid]] | None" = None
    frames: "Callable[[int], list[FramePair]] | None" = None
    deformation: Deformation | None = None
    states: "Callable[[], States] | None" = None

    def mapped(
        self, state: "Callable[[State], State] | None" = None, volume: "VolumeMap | None" = None, **changes: Any
    ) -> "Progress":
        """Returns the report with ``changes`` of its fields. The functions ``state`` and ``volume``, if given, are applied
        to what the report's own functions of the same name return."""
        own_state, own_volume = self.state, self.volume
        if state is not None and own_state is not None:
            changes["state"] = lambda: state(own_state())
        if volume is not None and own_volume is not None:
            changes["volume"] = lambda: volume(*own_volume())
        return replace(self, **changes)


ProgressReport = Callable[[Progress], None]


def through(hook: Callable[[Progress], Progress], report: ProgressReport) -> ProgressReport:
    """Returns a report that gets progress as ``hook`` changes it."""
    return lambda progress: report(hook(progress))


def labelled(label: str, report: ProgressReport) -> ProgressReport:
    """Returns a report that gets progress under the name ``label``, without a state, as it has no checkpoint."""
    return through(lambda progress: replace(progress, quantity=f"{label}: {progress.quantity}", state=None), report)


def ignore_progress(progress: Progress) -> None:
    """The default report: does nothing."""


def function_name(function: object) -> str:
    """Returns ``module:name`` of a function, or of the class of another callable."""
    of = function if hasattr(function, "__qualname__") else type(function)
    return f"{of.__module__}:{of.__qualname__}"


def option_facts(options: Any) -> dict[str, object]:
    """Returns a method's options by name, as facts of its result. A function among them is stated as ``module:name``."""
    own = {"motion": motion_facts(options.motion)} if hasattr(options, "motion") else {}
    given = {name: getattr(options, name) for name in getattr(options, "FUNCTIONS", ())}
    named = {name: function_name(value) for name, value in given.items() if callable(value)}
    return {**asdict(replace(options, **named) if named else options), **own}
