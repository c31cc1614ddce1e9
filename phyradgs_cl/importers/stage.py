"""A sample on a rotary stage between a source and a panel at rest, and how far its axis is off the central ray."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from phyradgs_cl.acquisition import CircularOrbit, PoseTable, Scan
from phyradgs_cl.acquisition.geometry import Geometry, ParallelGeometry, plain_geometry
from phyradgs_cl.importers import assemble
from phyradgs_cl.importers.assemble import StoredTiming, Timing
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.reading.frames import line_integrals, oriented


@dataclass(frozen=True, eq=False)
class RotaryStage:
    """A source and a panel of ``geometry``, and an axis of rotation off the central ray, seen from the source.

    ``axis_u_mm``: the axis stands that far to the right, at its own distance. ``roll_rad``: its top leans to the right;
    ``tilt_rad``: its top leans towards the panel. ``shift_mm`` (F, 2): shifts (v, u) of the panel per frame, or None."""

    geometry: Geometry
    axis_u_mm: float = 0.0
    roll_rad: float = 0.0
    tilt_rad: float = 0.0
    shift_mm: np.ndarray | None = None

    def poses(self, angle_rad: np.ndarray, shift_mm: np.ndarray | float = 0.0) -> np.ndarray:
        """Returns the poses (T, 12) in the sample's frame at gantry angles (T,), with shifts (T, 2) of the panel."""
        upright = self.geometry.pose(0.0).reshape(4, 3)  # x to the source, y to the right, z up
        is_parallel = isinstance(self.geometry, ParallelGeometry)
        parts = np.repeat(upright[None], len(angle_rad), axis=0)
        parts[:, int(is_parallel) : 2, 1] -= self.axis_u_mm  # the axis becomes the origin
        parts[:, 1, 2:0:-1] += shift_mm
        leaning = Rotation.from_euler("YX", [-self.tilt_rad, -self.roll_rad])  # turns the z axis to the stage's
        turned = (Rotation.from_euler("z", np.reshape(angle_rad, (-1, 1))) * leaning.inv()).as_matrix()
        return np.asarray(np.einsum("tij,tkj->tki", turned, parts).reshape(-1, 12))

    def turned(
        self, angle_rad: np.ndarray, timing: Timing, subject: str
    ) -> tuple[CircularOrbit | PoseTable, Geometry]:
        """Returns the trajectory of gantry angles (F,) and its plain geometry: a circular orbit where the axis crosses the
        central ray at a right angle, else a table of poses."""
        if self.axis_u_mm == self.roll_rad == self.tilt_rad == 0 and self.shift_mm is None:
            return assemble.turning(self.geometry, angle_rad, timing), self.geometry
        unwrapped = np.unwrap(angle_rad)
        shift_mm = np.zeros((len(unwrapped), 2)) if self.shift_mm is None else self.shift_mm

        def poses(position: np.ndarray) -> np.ndarray:
            return self.poses(along(unwrapped, position), along(shift_mm, position))

        is_parallel = isinstance(self.geometry, ParallelGeometry)
        at_frames = poses(np.arange(len(unwrapped), dtype=np.float64))
        geometry = plain_geometry(at_frames, self.geometry.detector_shape, is_parallel)
        return assemble.table_over_time(poses, timing, subject, is_parallel), geometry


@dataclass(frozen=True, eq=False)
class StageScan:
    """Counts (F, v, u) of a sample on a stage with the first row and column at ``sides``, and gantry angles (F,) in rad.

    ``places`` (F,): numbers of the frames from 0 on; ``stored``: the file's timing; ``said``, ``names``: see
    ``assemble_scan``. Flats and darks are (n, v, u), or None where the scanner has applied them."""

    frames: np.ndarray
    sides: tuple[str, str]
    angle_rad: np.ndarray
    places: np.ndarray
    names: dict[str, str]
    said: str
    stored: StoredTiming | None = None
    flats: np.ndarray | None = None
    darks: np.ndarray | None = None

    def on(
        self, stage: RotaryStage, options: ImportOptions, path: Path, title: str, flat_value: float | None = None
    ) -> Scan:
        """Returns the scan of the description ``path``. ``flat_value``: the file's counts of air; options come first."""
        timing = assemble.make_timing(str(path), self.places, options, self.stored)
        trajectory, geometry = stage.turned(self.angle_rad, timing, str(path))
        flats, darks = (None if one is None else oriented(one, options, *self.sides) for one in (self.flats, self.darks))
        frames, options = oriented(self.frames, options, *self.sides), options.with_air(flat_value)
        integrals = line_integrals(
            str(path), frames, options, flats=flats, darks=darks, convention="counts", is_corrected=darks is None
        )
        parts = integrals, trajectory, geometry, timing, options
        return assemble.assemble_scan(*parts, title=title, source=str(path), names=self.names, said=self.said)


def along(values: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Returns values (F, ...) at frame positions (T,), linear between frames and beyond them."""
    if len(values) == 1:
        return np.repeat(values, len(position), axis=0)
    left = np.clip(np.floor(position).astype(int), 0, len(values) - 2)
    part = (position - left).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(values[left] + part * (values[left + 1] - values[left]))
