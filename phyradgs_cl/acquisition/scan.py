"""A scan: its line integrals, geometry, timing and trajectory, and the grid to reconstruct."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike

from phyradgs_cl import checks
from phyradgs_cl.acquisition.geometry import (
    GEOMETRIES,
    POSE_LENGTH,
    Geometry,
    ParallelGeometry,
    check_distances,
    default_grid,
    field_of_view_mm,
    hidden,
    misses,
    panel_behind_mm,
    plain_geometry,
)
from phyradgs_cl.acquisition.plausible import FEW, OPAQUE, summary
from phyradgs_cl.acquisition.plot import plot_frame
from phyradgs_cl.acquisition.shutter import Shutter
from phyradgs_cl.acquisition.toolkits import astra_of_poses, is_parallel_tigre, poses_of_astra, poses_of_tigre
from phyradgs_cl.acquisition.trajectory import (
    CircularOrbit,
    Trajectory,
    behind_axis,
    checked_poses,
    is_parallel,
    resting_trajectory,
    unit_directions,
)
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Gating, Grid, GridChoice, MovingTruth
from phyradgs_cl.text import suggest_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)
DETECTOR_MODELS = ("log", "intensity")
APPLIED = ("flats_applied", "darks_applied")
"""Keys of the provenance for the numbers of flats and darks that were applied to the counts."""
_OTHERS = ("detector_model", "pixel_mask", "reference", "title", "lag", "provenance")
_TITLE = "cone-beam scan"
_CHECKED = WeakValueDictionary[int, np.ndarray]()  # frames of scans, which are looked through once
LARGEST_LAG = 0.9  # far beyond any panel; towards 1 a frame holds hardly any new information


@dataclass(frozen=True)
class Saturation:
    """The largest raw count, and the fraction of pixels clipped there, before counts became line integrals."""

    level: float
    share: float


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """One scan of a cone or a parallel beam, in line integrals.

    - projections (F, nv, nu) float32: −ln(I/I0), dimensionless. Row 0 is the lowest.
    - geometry and grid in mm, shutter in s. A panel scaled to the axis is moved behind the object.
    - trajectory: anything with ``pose(frame, time_s)``, a user-defined class too.
    - frame_start_s (F,): when the first-read line opens, in s.
    - is_fly: False for stop-and-shoot scans, whatever the exposure time.
    - detector_model: quantity that the detector averages over an exposure, "log" (line integrals) or "intensity".
    - pixel_mask (nv, nu) or (F, nv, nu): non-zero for pixels not to be used; lines that a pulsed beam misses are added.
    - reference (nz, ny, nx): the true volume in 1/mm on ``grid``. moving_truth: of a simulated object that moves, its true
      states on ``grid`` and its deformation.
    - gating: a signal or a phase that was recorded beside the frames, of an object that moves.
    - lag: share λ of the recorded intensity that stems from earlier frames (detector/effects.py), still in the projections.
    - saturation: None where raw counts were not examined. title and provenance are stored in files.

    Raises InputError for shapes that do not fit each other, and for line integrals that are not finite."""

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

    def __post_init__(self) -> None:
        kinds_of = {"geometry": GEOMETRIES, "shutter": (Shutter,), "grid": (Grid,), "gating": (Gating, type(None))}
        for name, kinds in kinds_of.items():
            if not isinstance(getattr(self, name), kinds):
                wanted = " or ".join(f"a {kind.__name__}" for kind in kinds)
                raise InputError(name, checks.short_repr(getattr(self, name)), wanted)
        if not callable(getattr(self.trajectory, "pose", None)):
            raise InputError("trajectory", checks.short_repr(self.trajectory), "anything with pose(frame, time_s)")
        if self.is_parallel != isinstance(self.geometry, ParallelGeometry):
            beam, other = ("parallel", "cone") if self.is_parallel else ("cone", "parallel")
            remedy = "make both of one kind; a trajectory of parallel beams has is_parallel = True"
            raise InputError("trajectory", f"a {beam} beam", f"a {other} beam, as the geometry", remedy)
        for name, value in zip(("geometry", "trajectory"), behind_axis(self.geometry, self.trajectory), strict=True):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "projections", _line_integrals(self.projections, self.pixel_mask))
        frames = len(self.projections)
        expected = (frames, *self.geometry.detector_shape)
        if self.projections.shape != expected:
            found = f"shape {self.projections.shape}"
            raise InputError("projections", found, f"(frames, rows, columns) = {expected}")
        if frames == 0:
            raise InputError("projections", "no frame", "at least one projection")
        object.__setattr__(self, "frame_start_s", checks.numbers("frame_start_s", self.frame_start_s, (frames,)))
        if not isinstance(self.title, str):
            raise InputError("title", checks.short_repr(self.title), "text")
        if self.is_parallel and self.title == _TITLE:
            object.__setattr__(self, "title", "parallel-beam scan")
        if self.detector_model not in DETECTOR_MODELS:
            raise InputError("detector_model", repr(self.detector_model), "'log' or 'intensity'")
        checks.within("lag", self.lag, 0, LARGEST_LAG)
        if self.reference is not None and self.reference.shape != self.grid.shape:
            raise InputError("reference", f"shape {self.reference.shape}", f"the grid's {self.grid.shape}")
        if self.moving_truth is not None and self.moving_truth.volumes.shape[1:] != self.grid.shape:
            found = f"states of shape {self.moving_truth.volumes.shape[1:]}"
            raise InputError("moving_truth", found, f"the grid's {self.grid.shape}")
        check_distances(self.geometry, self.grid)
        if self.pixel_mask is not None and np.shape(self.pixel_mask) not in (expected, expected[1:]):
            raise InputError("pixel_mask", f"shape {np.shape(self.pixel_mask)}", f"{expected[1:]} or {expected}")
        self._mask_dark_lines()

    @property
    def is_parallel(self) -> bool:
        """True for a parallel beam: poses begin with the direction of the rays."""
        return is_parallel(self.trajectory)

    def __repr__(self) -> str:
        rows, columns = self.geometry.detector_shape
        voxels, sides = (" × ".join(f"{n:g}" for n in three) for three in (self.grid.shape, self.grid.size_mm))
        shutter = self.shutter
        times = f"exposure {shutter.exposure_s:g} s, readout {shutter.readout_s:g} s along {shutter.axis}"
        taken = f"fly-scan, {times}" if self.is_fly else "stop-and-shoot"
        return f"Scan({self.title!r}, {self.frames} frames of {rows} × {columns}, {taken}, grid {voxels} in {sides} mm)"

    @classmethod
    def from_poses(
        cls, frames: "ArrayLike", poses: "ArrayLike", grid: Grid | None = None, *, is_parallel: bool = False, **others: Any
    ) -> "Scan":
        """Makes a stop-and-shoot scan with one pose for every frame.

        frames (F, rows, columns): line integrals. poses (F, 12) in mm: source, centre of pixel (0, 0), step to the next
        column, step to the next row, x y z each; with ``is_parallel`` the direction of the rays, of any length, in place of
        the source. grid: None takes the field of view of a full turn, and the travel along z. others: the fields
        detector_model, pixel_mask, reference, title, lag and provenance of ``Scan``.

        Raises InputError for shapes that do not fit, and for poses from which no ray meets the grid."""
        values = _uncounted(frames, others.get("pixel_mask"))
        checks.shape("frames", values, (None, None, None))
        table = checks.numbers("poses", poses, (len(values), POSE_LENGTH))
        if (np.linalg.norm(np.cross(table[:, 6:9], table[:, 9:12]), axis=1) <= 0).any():
            raise InputError("poses", "parallel pixel steps", "steps along columns and rows that span a panel")
        panel = (values.shape[1], values.shape[2])
        if is_parallel:
            table = unit_directions("poses", table)
        geometry = plain_geometry(table, panel, is_parallel)
        shutter, start_s = Shutter(0.0), np.arange(len(values), dtype=np.float64)
        trajectory = resting_trajectory(geometry, table, start_s)
        check_others(others)
        grid = grid or default_grid(geometry, table)
        scan = cls(values, geometry, trajectory, shutter, start_s, grid, False, **others)
        scan.check_sight()
        return scan

    @classmethod
    def from_astra(
        cls, frames: "ArrayLike", vectors: "ArrayLike", grid: Grid | None = None, *, is_parallel: bool = False, **others: Any
    ) -> "Scan":
        """Makes a stop-and-shoot scan from the vectors of an ASTRA geometry ``cone_vec``; ``astra_vectors`` inverts it.

        frames (F, rows, columns): line integrals. ASTRA's order is (rows, F, columns): give ``sinogram.swapaxes(0, 1)``.
        vectors (F, 12) in mm: source, centre of the panel, step from column to column, from row to row. With
        ``is_parallel`` they are those of ``parallel3d_vec``, which begin with the direction of the rays. grid, others: as in
        ``from_poses``. Raises InputError for shapes that do not fit."""
        values, table = _uncounted(frames, others.get("pixel_mask")), np.asarray(vectors)
        checks.shape("vectors", table, (None, POSE_LENGTH))
        if values.ndim == 3 and len(values) != len(table) == values.shape[1]:
            remedy = "ASTRA's order is (rows, frames, columns): give frames.swapaxes(0, 1)"
            raise InputError("frames", f"shape {values.shape}", f"({len(table)}, rows, columns)", remedy)
        checks.shape("frames", values, (len(table), None, None))
        panel = values.shape[1], values.shape[2]
        return cls.from_poses(values, poses_of_astra(table, panel), grid, is_parallel=is_parallel, **others)

    @classmethod
    def from_tigre(cls, geo: Any, angles: "ArrayLike", frames: "ArrayLike", **others: Any) -> "Scan":
        """Makes a stop-and-shoot scan from a TIGRE geometry, without TIGRE installed.

        geo: anything with TIGRE's attributes in mm: DSD, DSO, nDetector, dDetector (v, u), nVoxel, dVoxel (z, y, x), and
        optionally offDetector (v, u), offOrigin (z, y, x) and COR, each one value for all frames or one per frame.
        angles (F,) in radians. frames (F, v, u): line integrals as TIGRE's ``Ax`` gives them. others: fields of ``Scan``.

        With geo.mode "parallel" the distances are not needed.

        Raises InputError for a turned panel, and attributes that are missing or do not fit."""
        check_others(others)
        poses, panel, grid = poses_of_tigre(geo, angles)
        checks.shape("frames", frames, (len(poses), *panel))
        return cls.from_poses(frames, poses, grid, is_parallel=is_parallel_tigre(geo), **others)

    def astra_vectors(self) -> np.ndarray:
        """Returns ASTRA's ``cone_vec`` or ``parallel3d_vec`` (F, 12) in mm, each frame at the middle of its lit window.

        ``from_astra`` inverts it. ASTRA stacks frames as (rows, F, columns): ``scan.projections.swapaxes(0, 1)``. Its
        volumes are (z, y, x) too."""
        times_s = self.frame_start_s + self.shutter.middle_s
        poses = np.stack([self.trajectory.pose(f, np.array(t)) for f, t in enumerate(times_s)])
        return astra_of_poses(poses, self.geometry.detector_shape)

    def summary(self) -> str:
        """Returns a line of shutter, frame rate and exposure, a line of field of view, voxels and line integrals, and of a
        fly-scan a line of its blur."""
        return summary(self)

    def plot(self, frame: int = 0) -> "Figure":
        """Returns a figure of one frame (rows, columns), and of the times and gantry angles at which its lines are open.
        Raises InputError for a frame number out of range."""
        return plot_frame(self, frame)

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
        """Pixels that may be used, bool (F, nv, nu); a view."""
        unmasked = True if self.pixel_mask is None else np.asarray(self.pixel_mask) == 0
        return np.broadcast_to(unmasked, self.projections.shape)

    @property
    def lines(self) -> int:
        """The number of lines along the readout axis."""
        return self.shutter.lines(self.geometry.detector_shape)

    def on_grid(self, grid: Grid) -> "Scan":
        """Returns the scan with another grid. A truth stays where the old grid contains the new one."""
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
        """Returns the scan with the chosen grid. Raises InputError for one outside the field of view of an orbit."""
        grid = choice.of(self.grid)
        if choice.roi_mm is not None and isinstance(self.trajectory, CircularOrbit) and misses(grid, self.geometry):
            half_mm = ", ".join(f"±{half:.4g}" for half in field_of_view_mm(self.geometry))
            expected = f"a box that meets the field of view, (z, y, x) {half_mm} mm"
            raise InputError("--roi-mm", str(choice.roi_mm), expected)
        return self.on_grid(grid)

    def check_timing(self) -> None:
        """Raises InputError for a trajectory that does not cover every frame's window, and for poses that are not numbers.
        Raises it too for an exposure too short for the precision of the scan's times."""
        self.shutter.check_resolved(self.frame_start_s)
        last_s = self.shutter.span_s if self.is_fly else self.shutter.middle_s  # a gantry at rest has one pose
        for frame, start_s in enumerate(self.frame_start_s):
            checked_poses(self.trajectory, frame, np.array([start_s, start_s + last_s]))

    def warn_of_near_panel(self) -> None:
        """Warns where the panel stands inside the grid as the first frame opens: no ray sees the part behind it."""
        if self.is_parallel:  # rays do not end at the panel
            return
        (pose,) = checked_poses(self.trajectory, 0, np.array(self.frame_start_s[:1]))
        behind_mm, half_mm = panel_behind_mm(self.grid, pose), min(self.grid.size_mm[1:]) / 2
        if 0 <= behind_mm < half_mm:
            text = "the panel stands %.4g mm behind the middle of the grid, inside of it: rays end there"
            log.warning(text, behind_mm)

    def warn_of_blind_places(self) -> None:
        """Warns of a grid beside the field of view of an orbit, and of a panel that sees no part of the rotation axis."""
        if not isinstance(self.trajectory, CircularOrbit):
            return
        fitting = default_grid(self.geometry)
        box_mm, half_mm = np.round(fitting.box_mm, 3).tolist(), np.round(field_of_view_mm(self.geometry), 3).tolist()
        if misses(self.grid, self.geometry):
            found_mm = np.round(self.grid.box_mm, 3).tolist()
            text = "the grid in %s mm (z, y, x) lies beside the field of view of ±%s mm: few views see its voxels, whose "
            text += "values mean nothing; a grid that fits: %s mm"
            log.warning(text, found_mm, half_mm, box_mm)
        offset_mm, pitch_mm = abs(self.geometry.detector_offset_mm[1]), self.geometry.pixel_size_mm[1]
        half_panel_mm = self.geometry.detector_shape[1] * pitch_mm / 2
        if offset_mm > half_panel_mm:
            text = "the panel of ±%.4g mm, %.4g mm off the central ray, does not see the rotation axis: the middle of the "
            text += "volume is not measured; is the offset in mm? As pixels it were %.4g mm"
            log.warning(text, half_panel_mm, offset_mm, offset_mm * pitch_mm)

    def warn_of_negative_integrals(self) -> None:
        """Warns of line integrals whose sum is below 0: most methods make a volume of zeros of them. Raises InputError where
        frames have become NaN or infinite since the scan was made of them."""
        total = float(np.sum(self.projections, where=self.valid, dtype=np.float64))
        if not np.isfinite(total):
            checks.finite("projections", np.where(self.valid, self.projections, 0))
        if total < 0:
            text = "line integrals are negative on the whole, %.3g on the mean: is their sign wrong? −ln(I/I0) is above 0"
            log.warning(text, total / np.count_nonzero(self.valid))

    def check_sight(self) -> None:
        """Raises InputError for a grid that no ray meets as any frame opens: its volume would be 0. Warns of a panel inside
        the grid."""
        self.warn_of_near_panel()
        places = set()
        for frame, start_s in enumerate(self.frame_start_s):
            (pose,) = checked_poses(self.trajectory, frame, np.array([start_s]))
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
    """Returns the provenance of line integrals for the numbers of flats and darks that were applied."""
    return {name: count for name, count in zip(APPLIED, (flats, darks), strict=True) if count}


def check_others(others: Iterable[str], arguments: Iterable[str] = ()) -> None:
    """Raises InputError for a keyword that is no optional field of ``Scan``; the caller takes ``arguments`` besides."""
    allowed = (*arguments, *_OTHERS)
    for name in others:
        if name not in _OTHERS:
            raise InputError(name, "no such option", ", ".join(allowed), suggest_name(name, allowed, "leave it out"))


def check_not_counts(frames: np.ndarray, remedy: str, mask: ArrayLike | None = None) -> None:
    """Raises InputError for frames that look like raw counts: whole numbers, or many unmasked values above 50."""
    if frames.dtype.kind in "iu":
        raise InputError("frames", f"whole numbers ({frames.dtype}) without flats", "line integrals", remedy)
    opaque = frames > OPAQUE
    if mask is not None and np.shape(mask) in (frames.shape, frames.shape[1:]):
        opaque &= np.asarray(mask) == 0
    if np.count_nonzero(opaque) > FEW * opaque.size:
        found = f"values of up to {frames[opaque].max():g} without flats"
        raise InputError("frames", found, f"line integrals, which are below {OPAQUE:g}", remedy)


def _uncounted(frames: ArrayLike, mask: np.ndarray | None) -> np.ndarray:
    """Returns ``_line_integrals`` of frames with no stated quantity. Raises InputError for counts."""
    values = checks.real_array("frames", frames)
    check_not_counts(values, "give −ln(counts / flats)", mask)
    return _line_integrals(values, mask)


def _line_integrals(frames: ArrayLike, mask: np.ndarray | None) -> np.ndarray:
    """Returns frames as float32, with 0 for masked pixels that are not finite. Raises InputError for others. Frames that a
    scan has had already are returned at once."""
    if isinstance(frames, np.ndarray) and _CHECKED.get(id(frames)) is frames:
        return frames
    values = checks.real_array("projections", frames)
    with np.errstate(over="ignore"):
        values = values.astype(np.float32, copy=False)
    if not all(np.isfinite(frame).all() for frame in values):  # by frame, which needs little memory
        if mask is not None and np.shape(mask) in (values.shape, values.shape[1:]):
            values = np.where((np.asarray(mask) != 0) & ~np.isfinite(values), np.float32(0), values)
        checks.finite("projections", values)
    _CHECKED[id(values)] = values
    return values
