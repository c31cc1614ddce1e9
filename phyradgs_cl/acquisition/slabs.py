"""Slabs of a parallel-beam scan: a few detector rows, which suffice to reconstruct the slices in front of them."""

from dataclasses import replace

import numpy as np

from phyradgs_cl.acquisition.geometry import ParallelGeometry
from phyradgs_cl.acquisition.scan import Scan
from phyradgs_cl.acquisition.trajectory import CircularOrbit
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid, triple

HALO_ROWS = 4
"""Number of detector rows read beyond each side of a slab. A slice between two rows needs both; priors need near slices."""


def check_has_slabs(scan: Scan, subject: str, found: str) -> None:
    """Raises InputError for anything but a parallel beam on a circular orbit: a slice of other scans needs rows of the whole
    panel. subject: the option that asked for a slab. found: the option's value."""
    if not has_slabs(scan):
        expected = "all rows: only in a parallel beam about z does a slice need few of them"
        raise InputError(subject, found, expected, "take --roi-mm, with --margin-mm")


def has_slabs(scan: Scan) -> bool:
    """Returns whether few detector rows suffice for a slice: true for a parallel beam on a circular orbit about z."""
    return isinstance(scan.geometry, ParallelGeometry) and isinstance(scan.trajectory, CircularOrbit)


def check_rows(scan: Scan, first: int, stop: int) -> None:
    """Raises InputError for rows [first, stop) that the panel lacks, and for a scan whose slices need all rows."""
    rows, found = scan.geometry.detector_shape[0], f"{first}:{stop}"
    check_has_slabs(scan, "--rows", found)
    if not 0 <= first < stop <= rows:
        raise InputError("--rows", found, f"first row and the one after the last, 0:{rows} at most", "row 0 is the lowest")


def slab(scan: Scan, first: int, stop: int) -> Scan:
    """Returns the scan with only the detector rows [first, stop), which keep their times. The grid stays the same.

    Raises InputError for rows that the panel lacks, and for a scan whose slices need all rows."""
    check_rows(scan, first, stop)
    geometry, shutter, rows = scan.geometry, scan.shutter, scan.geometry.detector_shape[0]
    pitch_v_mm, (offset_v_mm, offset_u_mm) = geometry.pixel_size_mm[0], geometry.detector_offset_mm
    offset_mm = (offset_v_mm + ((first + stop) - rows) / 2 * pitch_v_mm, offset_u_mm)
    panel = replace(geometry, detector_shape=(stop - first, geometry.detector_shape[1]), detector_offset_mm=offset_mm)
    later_s = 0.0
    if shutter.axis == "rows":
        shutter, later_s = shutter.of_lines(rows, first, stop)
    mask = None if scan.pixel_mask is None else np.asarray(scan.pixel_mask)[..., first:stop, :]
    assert isinstance(scan.trajectory, CircularOrbit)
    return replace(
        scan, projections=scan.projections[:, first:stop], geometry=panel, shutter=shutter, pixel_mask=mask,
        trajectory=CircularOrbit(panel, scan.trajectory.kinematics), frame_start_s=scan.frame_start_s + later_s,
    )


def slices_of(scan: Scan, first: int, stop: int) -> slice:
    """Returns the range, maybe empty, of the grid's slices whose centres lie at the height of detector rows [first, stop).
    Slices beyond the panel belong to its first or last row, so that slabs of all rows together have every slice."""
    rows, pitch_mm = scan.geometry.detector_shape[0], scan.geometry.pixel_size_mm[0]
    row = (scan.grid.axes_mm()[0] - scan.geometry.detector_offset_mm[0]) / pitch_mm + (rows - 1) / 2
    number = np.clip(np.floor(row + 0.5), 0, rows - 1)
    inside = np.flatnonzero((number >= first) & (number < stop))
    return slice(int(inside[0]), int(inside[-1]) + 1) if inside.size else slice(0, 0)


def part_of(grid: Grid, slices: slice) -> Grid:
    """Returns the part of ``grid`` with the given slices, or ``grid`` itself for all slices."""
    if slices == slice(0, grid.shape[0]):
        return grid
    return grid.part(triple((slices.start, 0, 0)), triple((slices.stop - slices.start, *grid.shape[1:])))
