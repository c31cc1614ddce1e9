"""An object that moves during the scan, as an input of a run: the deformation, and whether it fits the scan."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Deformation, Grid, triple

_SUBJECT = "--object-motion"
_MOST_VOXELS = 24  # along a side of the grid on which a deformation is looked at
_LEAST_DETERMINANT = 0.05
_LEAST_COVERED, _MOSTLY_COVERED = 0.5, 0.98  # of the scan, by the times of a deformation: below the first it is refused
log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ObjectMotion:
    """How the object moves during the scan. facts: which file holds it, for provenance."""

    deformation: Deformation
    facts: Mapping[str, str] = field(default_factory=dict)


def check_object_motion(deformation: Deformation, scan: Scan) -> None:
    """Raises InputError for a deformation of another place, another time or another unit than the scan's, and where matter
    folds or is compressed to nothing."""
    _check_times(deformation, scan)
    grid = _coarse(scan.grid)
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
        log.warning("%s: found %s; before and after its times the object rests", _SUBJECT, found)


def _coarse(grid: Grid) -> Grid:
    """Returns a grid of the same box with few voxels."""
    shape = triple(min(n, _MOST_VOXELS) for n in grid.shape)
    return Grid(shape, triple(side / n for side, n in zip(grid.size_mm, shape, strict=True)), grid.offset_mm)
