"""Motion models: how a reconstruction turns a frame of a scan into time cells."""

from __future__ import annotations

from dataclasses import dataclass

from phyradgs_cl import checks
from phyradgs_cl.acquisition import cells
from phyradgs_cl.acquisition.cells import TimeCells
from phyradgs_cl.acquisition.scan import Scan
from phyradgs_cl.errors import InputError

MOTIONS = ("static", "static-start", "micro-views", "per-row", "exact")


@dataclass(frozen=True)
class Motion:
    """A named motion model; ``strips`` (M) and ``sub_intervals`` (N) matter to micro-views only.

    ``per-row`` takes every line at its own N exact times; it is what the simulator uses. ``exact`` has ``segments``
    poses a frame, between which splats move while every line integrates; 0 chooses the number so that the error stays
    below ``time_error`` (relative), which also bounds the rules that average over time.
    """

    name: str = "micro-views"
    strips: int = 8
    sub_intervals: int = 5
    segments: int = 0
    time_error: float = 0.005

    def __post_init__(self) -> None:
        if self.name not in MOTIONS:
            raise InputError("motion", repr(self.name), f"one of {', '.join(MOTIONS)}")
        checks.within("strips", self.strips, 1, 10_000)
        checks.within("sub-intervals", self.sub_intervals, 1, 10_000)
        checks.within("--segments (0 chooses from the time error)", self.segments, 0, 1000)
        checks.within("--time-error", self.time_error, 1e-6, 1)

    def cells(self, scan: Scan, frame: int, intensity_peak: float = 0.0) -> TimeCells:
        """The time cells of one frame; a scan that is not a fly-scan has one pose a frame in every model.

        intensity_peak: as for ``segments_for``.
        """
        where = (scan.trajectory, scan.shutter, frame, float(scan.frame_start_s[frame]), scan.lines)
        if self.name == "static-start":
            return cells.static_start_cells(*where)
        if self.name == "static" or not scan.is_fly:
            return cells.static_cells(*where)
        if self.name == "micro-views":
            return cells.micro_view_cells(*where, self.strips, self.sub_intervals)
        if self.name == "exact":
            segments = self.segments or cells.segments_for(*where[:4], self.time_error, intensity_peak)
            return cells.exact_cells(*where, segments)
        return cells.per_line_cells(*where, self.sub_intervals)
