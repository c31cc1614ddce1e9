"""``Scan``: line integrals with their geometry, timing and trajectory, and the grid to reconstruct."""

import logging
from dataclasses import dataclass, field, replace

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import plausible, scans_from
from phyradgs_cl.acquisition.geometry import (
    GEOMETRIES,
    Geometry,
    ParallelGeometry,
    check_distances,
    default_grid,
    field_of_view_mm,
    hidden,
    misses,
    panel_behind_mm,
)
from phyradgs_cl.acquisition.plot import plot_frame
from phyradgs_cl.acquisition.scans_from import line_integrals
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.trajectory import CircularOrbit, Trajectory, behind_axis, checked, is_parallel
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gating, Grid, GridChoice, Metal, MovingTruth

log = logging.getLogger(__name__)
DETECTOR_MODELS = ("log", "intensity")
MODELS_OF_METHODS = ("scan", *DETECTOR_MODELS)  # "scan" takes the detector model that the scan states
APPLIED = ("flats_applied", "darks_applied")
"""Keys of a scan's provenance under which the numbers of applied flats and darks are stored."""
_TITLE = "cone-beam scan"
LARGEST_LAG = 0.9  # largest ``Scan.lag``: panels have less, and a frame with a lag of 1 would show only earlier frames


@dataclass(frozen=True)
class Saturation:
    """Saturation of a scan's raw counts. level: the largest count. share: the fraction of pixels clipped at this count."""

    level: float
    share: float


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """One scan of a cone or a parallel beam, in line integrals.

    - projections (F, nv, nu) float32: −ln(I/I0), dimensionless. Row 0 is the lowest.
    - geometry and grid in mm, shutter in s. A panel at the axis, as some programs state it, is moved behind the object.
    - trajectory: anything with ``pose(frame, time_s)``, also a user-defined class.
    - frame_start_s (F,): when each frame's first line opens, in s.
    - is_fly: False if the gantry stops for every frame (stop-and-shoot), whatever the exposure time.
    - detector_model: the quantity that the detector averages over an exposure, "log" (line integrals) or "intensity".
    - pixel_mask (nv, nu) or (F, nv, nu): non-zero for pixels not to be used. Lines that a pulsed beam misses are masked too.
    - reference (nz, ny, nx): the true volume in 1/mm on ``grid``. moving_truth: true volumes and motion of a simulated
      object that moves.
    - gating: a signal or phase of a moving object, recorded with the frames.
    - metal: the metal that is put back into reconstructed volumes. pixel_mask hides its shadow (docs/prepare.md).
    - lag: the fraction λ of the recorded intensity that comes from earlier frames (detector/effects.py). The projections
      still contain it.
    - saturation: None if raw counts were not examined. title and provenance are stored in files.

    Raises InputError for fields of a wrong kind or out of range, for shapes that do not fit each other, and for line
    integrals of unmasked pixels that are not finite."""

    projections: np.ndarray
    geometry: "Geometry"
    trajectory: Trajectory
    shutter: Shutter
    frame_start_s: np.ndarray
    grid: Grid
    is_fly: bool = True
    detector_model: str = "log"
    pixel_mask: np.ndarray | None = None
    reference: np.ndarray | None = None
    title: str = _TITLE
    provenance: dict[str, object] = field(default_factory=dict)
    lag: float = 0.0
    saturation: Saturation | None = None
    moving_truth: MovingTruth | None = None
    gating: Gating | None = None
    metal: Metal | None = None
    _checked: np.ndarray | None = field(default=None, kw_only=True)
    """The array of projections that was last found finite. ``replace`` passes it on, so that no array is checked twice."""

    def __post_init__(self) -> None:
        self._check_kinds()
        for name, value in zip(("geometry", "trajectory"), behind_axis(self.geometry, self.trajectory), strict=True):
            object.__setattr__(self, name, value)
        if self.projections is not self._checked:
            object.__setattr__(self, "projections", line_integrals(self.projections, self.pixel_mask))
            object.__setattr__(self, "_checked", self.projections)
        self._check_shapes()
        frame_start_s = checks.numbers("frame_start_s", self.frame_start_s, (self.frames,))
        object.__setattr__(self, "frame_start_s", frame_start_s)
        if self.is_parallel and self.title == _TITLE:
            object.__setattr__(self, "title", "parallel-beam scan")
        checks.within("lag", self.lag, 0, LARGEST_LAG)
        check_distances(self.geometry, self.grid)
        self._mask_dark_lines()

    def _check_kinds(self) -> None:
        kinds_of = {"geometry": GEOMETRIES, "shutter": (Shutter,), "grid": (Grid,), "gating": (Gating, type(None))}
        for name, kinds in kinds_of.items():
            if not isinstance(getattr(self, name), kinds):
                wanted = " or ".join(f"a {kind.__name__}" for kind in kinds)
                raise InputError(name, checks.short_repr(getattr(self, name)), wanted)
        checks.flag("is_fly", self.is_fly)
        if not isinstance(self.title, str):
            raise InputError("title", checks.short_repr(self.title), "text")
        if self.detector_model not in DETECTOR_MODELS:
            raise InputError("detector_model", repr(self.detector_model), "'log' or 'intensity'")
        if not callable(getattr(self.trajectory, "pose", None)):
            raise InputError("trajectory", checks.short_repr(self.trajectory), "anything with pose(frame, time_s)")
        object.__setattr__(self, "trajectory", checked(self.trajectory))
        if self.is_parallel != isinstance(self.geometry, ParallelGeometry):
            beam, other = ("parallel", "cone") if self.is_parallel else ("cone", "parallel")
            remedy = "make both of one kind; a trajectory of parallel beams has is_parallel = True"
            raise InputError("trajectory", f"a {beam} beam", f"a {other} beam, as the geometry", remedy)

    def _check_shapes(self) -> None:
        expected = (self.frames, *self.geometry.detector_shape)
        if self.projections.shape != expected:
            found = f"shape {self.projections.shape}"
            raise InputError("projections", found, f"(frames, rows, columns) = {expected}")
        if self.frames == 0:
            raise InputError("projections", "no frame", "at least one projection")
        if self.reference is not None:
            object.__setattr__(self, "reference", checks.real_array("reference", self.reference))
            if np.shape(self.reference) != self.grid.shape:
                raise InputError("reference", f"shape {np.shape(self.reference)}", f"the grid's {self.grid.shape}")
        if self.moving_truth is not None and self.moving_truth.volumes.shape[1:] != self.grid.shape:
            found = f"states of shape {self.moving_truth.volumes.shape[1:]}"
            raise InputError("moving_truth", found, f"the grid's {self.grid.shape}")
        checks.unmasked("pixel_mask", self.pixel_mask)
        if self.pixel_mask is not None and np.shape(self.pixel_mask) not in (expected, expected[1:]):
            raise InputError("pixel_mask", f"shape {np.shape(self.pixel_mask)}", f"{expected[1:]} or {expected}")

    @property
    def is_parallel(self) -> bool:
        """True for a parallel beam, whose poses begin with the direction of the rays."""
        return is_parallel(self.trajectory)

    def __repr__(self) -> str:
        rows, columns = self.geometry.detector_shape
        voxels, sides = (" × ".join(f"{n:g}" for n in three) for three in (self.grid.shape, self.grid.size_mm))
        shutter = self.shutter
        times = f"exposure {shutter.exposure_s:g} s, readout {shutter.readout_s:g} s along {shutter.axis}"
        taken = f"fly-scan, {times}" if self.is_fly else "stop-and-shoot"
        return f"Scan({self.title!r}, {self.frames} frames of {rows} × {columns}, {taken}, grid {voxels} in {sides} mm)"

    from_poses = classmethod(scans_from.from_poses)
    from_astra = classmethod(scans_from.from_astra)
    from_tigre = classmethod(scans_from.from_tigre)
    astra_vectors = scans_from.astra_vectors
    summary = plausible.summary
    plot = plot_frame

    def _mask_dark_lines(self) -> None:
        dark = self.shutter.lit_share(self.lines) == 0
        if not dark.any():
            return
        unlit = np.broadcast_to(self.shutter.readout.spread(dark), self.geometry.detector_shape)
        mask = unlit if self.pixel_mask is None else (np.asarray(self.pixel_mask) != 0) | unlit
        object.__setattr__(self, "pixel_mask", mask)

    @property
    def frames(self) -> int:
        """The number of frames F."""
        return len(self.projections)

    @property
    def valid(self) -> np.ndarray:
        """True for pixels that may be used: a bool view (F, nv, nu)."""
        unmasked = True if self.pixel_mask is None else np.asarray(self.pixel_mask) == 0
        return np.broadcast_to(unmasked, self.projections.shape)

    @property
    def middle_times_s(self) -> np.ndarray:
        """The times (F,) in s in the middle between a frame's first and last light."""
        return np.asarray(self.frame_start_s, np.float64) + self.shutter.middle_s

    @property
    def lines(self) -> int:
        """The number of lines that the shutter reads one after the other: rows or columns."""
        return self.shutter.lines(self.geometry.detector_shape)

    def on_grid(self, grid: Grid) -> "Scan":
        """Returns the scan on ``grid``. True volumes are cut to a ``grid`` that is a part of the scan's, else dropped."""
        if grid == self.grid:
            return self
        part = grid.slices_in(self.grid)
        if part is None:
            return replace(self, grid=grid, reference=None, moving_truth=None)
        reference, moving = self.reference, self.moving_truth
        reference = None if reference is None else reference[part]
        if moving is not None:
            along_z, along_y, along_x = part
            moving = replace(moving, volumes=moving.volumes[:, along_z, along_y, along_x])
        return replace(self, grid=grid, reference=reference, moving_truth=moving)

    def with_grid(self, choice: GridChoice) -> "Scan":
        """Returns the scan with the grid of ``choice``. Raises InputError for a region of interest outside a circular
        orbit's field of view."""
        grid = choice.of(self.grid)
        if choice.roi_mm is not None and isinstance(self.trajectory, CircularOrbit) and misses(grid, self.geometry):
            seen_mm = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in field_of_view_mm(self.geometry))
            expected = f"a box that meets the field of view, (z, y, x) {seen_mm} mm"
            raise InputError("--roi-mm", str(choice.roi_mm), expected)
        return self.on_grid(grid)

    def check_timing(self) -> None:
        """Raises InputError for a trajectory that does not cover every frame, poses that are not finite, and an exposure too
        short for the precision of the scan's times."""
        self.shutter.check_resolved(self.frame_start_s)
        last_s = self.shutter.span_s if self.is_fly else self.shutter.middle_s  # a frame at rest has one pose, in its middle
        for frame, start_s in enumerate(self.frame_start_s):
            self.trajectory.pose(frame, np.array([start_s, start_s + last_s]))

    def warn_of_near_panel(self) -> None:
        """Warns if, as the first frame opens, the panel of a cone beam stands inside the grid, at its middle or behind. No
        ray sees the part of the grid behind the panel."""
        if self.is_parallel:  # parallel rays are not cut off at the panel
            return
        (pose,) = self.trajectory.pose(0, np.array(self.frame_start_s[:1]))
        behind_mm, half_mm = panel_behind_mm(self.grid, pose), min(self.grid.size_mm[1:]) / 2
        if 0 <= behind_mm < half_mm:
            text = "the panel stands %.4g mm behind the middle of the grid, inside of it: rays end there"
            log.warning(text, behind_mm)

    def warn_of_blind_places(self) -> None:
        """Warns, for a circular orbit, of a grid outside the field of view and of a panel that misses the rotation axis."""
        if not isinstance(self.trajectory, CircularOrbit):
            return
        fitting = default_grid(self.geometry)
        box_mm, seen_mm = (np.round(box, 3).tolist() for box in (fitting.box_mm, field_of_view_mm(self.geometry)))
        if misses(self.grid, self.geometry):
            found_mm = np.round(self.grid.box_mm, 3).tolist()
            text = "the grid in %s mm (z, y, x) lies beside the field of view, %s mm: few views see its voxels, whose "
            text += "values mean nothing; a grid that fits: %s mm"
            log.warning(text, found_mm, seen_mm, box_mm)
        offset_mm, pitch_mm = abs(self.geometry.detector_offset_mm[1]), self.geometry.pixel_size_mm[1]
        half_panel_mm = self.geometry.detector_shape[1] * pitch_mm / 2
        if offset_mm > half_panel_mm:
            text = "the panel of ±%.4g mm, %.4g mm off the central ray, does not see the rotation axis: the middle of the "
            text += "volume is not measured; is the offset in mm? As pixels it were %.4g mm"
            log.warning(text, half_panel_mm, offset_mm, offset_mm * pitch_mm)

    def warn_of_negative_integrals(self) -> None:
        """Warns of line integrals with a negative sum, from which most methods make a volume of zeros.

        Raises InputError if frames have become NaN or infinite since the scan was made."""
        total = float(np.sum(self.projections, where=self.valid, dtype=np.float64))
        if not np.isfinite(total):
            checks.finite("projections", np.where(self.valid, self.projections, 0))
        if total < 0:
            text = "line integrals are negative on the whole, %.3g on the mean: is their sign wrong? −ln(I/I0) is above 0"
            log.warning(text, total / np.count_nonzero(self.valid))

    def check_sight(self) -> None:
        """Raises InputError for a grid that no ray meets at the start of any frame, because the volume would be 0.

        Warns of a panel inside the grid."""
        self.warn_of_near_panel()
        places = set()
        for frame, start_s in enumerate(self.frame_start_s):
            (pose,) = self.trajectory.pose(frame, np.array([start_s]))
            place = hidden(self.grid, pose, self.geometry.detector_shape, self.is_parallel)
            if not place:
                return
            places.add(place)
        subject = getattr(self.trajectory, "subject", "trajectory")
        if places == {"behind the panel"}:
            remedy = "are the source's distances to axis and panel exchanged?"
            expected = "the grid between source and panel"
            raise InputError(subject, "the grid behind the panel in every frame", expected, remedy)
        box_mm = np.round(self.grid.box_mm, 3).tolist()
        found = f"a box in {box_mm} mm (z, y, x) that no ray meets in any frame"
        raise InputError("grid", found, "one that the panel sees", "correct its offset or unit, or the poses")


def applied_facts(flats: int, darks: int) -> dict[str, object]:
    """Returns the entries of a scan's provenance for the numbers of applied flats and darks, without those that are 0."""
    return {name: count for name, count in zip(APPLIED, (flats, darks), strict=True) if count}
