"""A scan: what was measured, where the gantry was, and the grid that is asked for."""

from dataclasses import dataclass, field, replace

import numpy as np

from phyradgs_cl.acquisition.field_of_view import field_of_view_mm, misses
from phyradgs_cl.acquisition.geometry import ConeGeometry
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.trajectory import CircularOrbit, Trajectory
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, GridChoice

DETECTOR_MODELS = ("log", "intensity")
LARGEST_LAG = 0.9  # far beyond any panel; towards 1 a frame says nothing of its own


@dataclass(frozen=True)
class Saturation:
    """What raw counts said before they became line integrals: the largest of them, and the share of pixels clipped there."""

    level: float
    share: float


@dataclass(frozen=True, eq=False)
class Scan:
    """One cone-beam scan in line integrals.

    projections (F, nv, nu) float32, dimensionless −ln(I/I0); frame_start_s (F,) opening of the first-read line;
    pixel_mask (nv, nu) or (F, nv, nu), non-zero = do not use; reference (nz, ny, nx) 1/mm on ``grid``.
    lag: share λ of the recorded intensity that comes from the frames before (detector/lag.py), still in the projections.
    Lines that a pulsed beam misses are added to the mask. ``saturation`` is None where nobody looked at raw counts.
    ``is_fly`` is false for stop-and-shoot scans, whatever the exposure time says.
    """

    projections: np.ndarray
    geometry: ConeGeometry
    trajectory: Trajectory
    shutter: Shutter
    frame_start_s: np.ndarray
    grid: Grid
    is_fly: bool = True
    detector_model: str = "log"
    pixel_mask: np.ndarray | None = None
    reference: np.ndarray | None = None
    title: str = "cone-beam scan"
    provenance: dict[str, object] = field(default_factory=dict)
    lag: float = 0.0
    saturation: Saturation | None = None

    def __post_init__(self) -> None:
        frames = len(self.projections)
        expected = (frames, *self.geometry.detector_shape)
        if self.projections.shape != expected:
            found = f"shape {self.projections.shape}"
            raise InputError("projections", found, f"(frames, rows, columns) = {expected}")
        if frames == 0:
            raise InputError("projections", "no frame", "at least one projection")
        if np.shape(self.frame_start_s) != (frames,):
            raise InputError("frame_start_s", f"shape {np.shape(self.frame_start_s)}", f"({frames},)")
        if self.detector_model not in DETECTOR_MODELS:
            raise InputError("detector_model", repr(self.detector_model), "'log' or 'intensity'")
        if not 0 <= self.lag <= LARGEST_LAG:
            raise InputError("lag", f"{self.lag:g}", f"a share from 0 to {LARGEST_LAG}")
        if self.reference is not None and self.reference.shape != self.grid.shape:
            raise InputError("reference", f"shape {self.reference.shape}", f"the grid's {self.grid.shape}")
        self._mask_dark_lines()

    def _mask_dark_lines(self) -> None:
        dark = self.shutter.lit_share(self.lines) == 0
        if not dark.any():
            return
        unlit = np.broadcast_to(self.shutter.readout.spread(dark), self.geometry.detector_shape)
        mask = unlit if self.pixel_mask is None else (np.asarray(self.pixel_mask) != 0) | unlit
        object.__setattr__(self, "pixel_mask", mask)

    @property
    def frames(self) -> int:
        return len(self.projections)

    @property
    def valid(self) -> np.ndarray:
        """Which pixels may be used, bool (F, nv, nu): a view."""
        unmasked = True if self.pixel_mask is None else np.asarray(self.pixel_mask) == 0
        return np.broadcast_to(unmasked, self.projections.shape)

    @property
    def lines(self) -> int:
        return self.shutter.lines(self.geometry.detector_shape)

    def on_grid(self, grid: Grid) -> "Scan":
        """The same scan with another grid; a reference stays where the grid is a part of its own, else it is left out."""
        if grid == self.grid:
            return self
        reference = self.reference
        if reference is not None:
            first = grid.start_in(self.grid)
            parts = None if first is None else [slice(s, s + n) for s, n in zip(first, grid.shape, strict=True)]
            reference = None if parts is None else reference[tuple(parts)]
        return replace(self, grid=grid, reference=reference)

    def with_grid(self, choice: GridChoice) -> "Scan":
        """The same scan with the grid that is chosen. Raises InputError for one that no ray of an orbit meets."""
        grid = choice.of(self.grid)
        if choice.roi_mm is not None and isinstance(self.trajectory, CircularOrbit) and misses(grid, self.geometry):
            half_mm = ", ".join(f"±{half:.4g}" for half in field_of_view_mm(self.geometry))
            expected = f"a box that meets the field of view, (z, y, x) {half_mm} mm"
            raise InputError("--roi-mm", str(choice.roi_mm), expected)
        return self.on_grid(grid)

    def check_timing(self) -> None:
        """InputError for a trajectory that ends before the last frame's window, an exposure too short for its times."""
        self.shutter.check_resolved(self.frame_start_s)
        last_s = self.shutter.span_s if self.is_fly else self.shutter.middle_s  # where a gantry stands
        for frame, start_s in enumerate(self.frame_start_s):
            self.trajectory.pose(frame, np.array([start_s, start_s + last_s]))
