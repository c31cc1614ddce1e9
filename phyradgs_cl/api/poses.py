"""Views moved one by one, and the gradient by that: for loops that look for poses themselves."""

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.api.devices import Device
from phyradgs_cl.api.projectors import ray_operator, splat_operator
from phyradgs_cl.api.runs import check_scan
from phyradgs_cl.calibrate import wobble
from phyradgs_cl.calibrate.moved import Change, moved
from phyradgs_cl.errors import InputError, naming_arguments
from phyradgs_cl.fields import Gaussians
from phyradgs_cl.fields.gaussians import ROWS

_STEP_PX = 0.25  # of a pixel at the image's edge: voxels leave more of a smaller one, edges bend in a larger


@naming_arguments()
def move_views(scan: Scan, views: np.ndarray, *, without_gauges: bool = False) -> Scan:
    """The scan whose views stand elsewhere than it says, its frames as they are.

    views: (F, 3), of each view the gantry's turn about the axis, counterclockwise as seen from above (rad), and the panel's
    shifts along its columns and rows (mm); all times of a view move alike. without_gauges: leave out of ``views`` what an
    object that is turned or lies elsewhere looks like (docs/calibrate.md). A file has one pose at a time: where frames
    overlap in time, ``save_scan`` refuses the result.

    Raises InputError for what is no Scan, and other shapes.
    """
    check_scan(scan)
    checks.numbers("views", views, (scan.frames, 3))
    numbers = np.asarray(views, np.float64)
    return moved(scan, Change(), wobble.views_of(wobble.without_gauges(scan, numbers) if without_gauges else numbers))


@naming_arguments()
def pose_gradient(
    scan: Scan,
    x: Gaussians | np.ndarray,
    by_frames: np.ndarray,
    motion: str | Motion | None = None,
    *,
    device: Device = None,
) -> np.ndarray:
    """dL/dviews (F, 3) float64 of ``move_views``, per rad and mm, from dL/dframes (F, rows, columns) of an object x.

    x: ``Gaussians``, by the chain rule through every line's own poses; or a volume (nz, ny, nx) in 1/mm on the scan's grid,
    by central differences of a quarter of a pixel. by_frames: of half the squared misfit, x's frames less the scan's; line
    integrals are averaged, whatever the detector. motion: as of ``splat_operator`` and ``ray_operator``, whose defaults
    these are when None. device: what ``--device`` takes, or a Runtime. After Choi et al. 2026.

    Raises InputError as the operators do.
    """
    check_scan(scan)
    pitch_mm = np.array(scan.geometry.pixel_size_mm)
    checks.numbers("by_frames", by_frames, scan.projections.shape)
    if isinstance(x, Gaussians):
        in_pixels = splat_operator(scan, motion or "exact", device=device).by_poses(x, by_frames)
        return in_pixels / np.array([1.0, *pitch_mm])
    if np.shape(x)[:1] == (ROWS,) and np.ndim(x) == 2:
        raise InputError("x", f"shape {np.shape(x)}", "Gaussians or a volume", "of rows (11, G): Gaussians.from_rows(rows)")
    checks.numbers("x", x, scan.grid.shape)
    found, units = np.zeros((scan.frames, 3)), wobble.units_of(scan) * _STEP_PX
    for kind, unit in enumerate(units):
        for sign in (1, -1):
            step = np.zeros((scan.frames, 3))
            step[:, kind] = sign * unit
            there = ray_operator(move_views(scan, step), motion or "per-row", device=device)(x)
            found[:, kind] += sign / (2 * unit) * np.einsum("fvu,fvu->f", there, by_frames, dtype=np.float64)
    return found
