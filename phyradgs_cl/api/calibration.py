"""Estimates a scan's geometry and timing from its frames, moves its views, and differentiates a loss by their poses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Motion, Scan
from phyradgs_cl.acquisition.altered.perturbed import GeometryCorrection, Views, perturb
from phyradgs_cl.api.projectors import ray_operator, splat_operator
from phyradgs_cl.api.runs import Device, check_scan, runtime_of
from phyradgs_cl.calibrate import Calibration
from phyradgs_cl.calibrate import calibrate as run_calibration
from phyradgs_cl.calibrate.per_view import WobbleParameters, units_of_views
from phyradgs_cl.errors import InputError, naming_arguments
from phyradgs_cl.fields import Gaussians
from phyradgs_cl.fields.gaussians import ROWS
from phyradgs_cl.importers import load_beads

# A central difference moves the image's edge by this many pixels to each side. With a smaller step, errors of voxels hide
# the change of the frames. With a larger step, the change is not linear.
_STEP_PX = 0.25


@naming_arguments()
def calibrate(
    scan: Scan, what: str | None = None, *, others: Sequence[Scan] = (), phantom: str | Path | None = None,
    splines: int = 0, device: Device = None,
) -> Calibration:
    """Estimates geometry and timing from the frames (docs/calibrate.md). Values that frames cannot show stay as stated.

    what: parameters' names, with commas. None means ``offset,roll,tilt``; of a fly-scan with rolling readout also
    ``readout,exposure``, and with a ``phantom`` also ``distance``; a parallel beam has neither tilt nor distance. Further
    names are ``direction``, ``motion`` and ``wobble`` (each view separately).
    others: more scans of the same object in the same place, with the same panel and the same errors as ``scan``.
    phantom: a TOML file of beads and wires (docs/formats.md) that describes the scanned object, at any place.
    splines: number of splines over time, at least 4, that describe a ``wobble``; 0 estimates every view separately.
    device: what ``--device`` takes, or a Runtime.

    The result has:
    ``scan``, corrected; ``parameters``, each as stated and as found, with its standard deviation in its unit (mm, deg, s)
    and a verdict (corrected, agrees, cannot tell); ``alike``, combinations of parameters that change no frame;
    ``residual_rms`` of line integrals, before and after; ``before`` and ``after``, residuals (F, rows, columns) of the
    coarsened frames; ``per_view()``, corrections (F,) of every view by name and unit; and ``plot()``, a figure of them.

    Raises InputError for unknown names, the timing of a gantry that stops, and fewer than 8 frames or 12 columns. Raises it
    also for other scans that do not fit the first, and for a phantom that the frames do not show."""
    check_scan(scan)
    scan.check_timing()
    checks.kind("what", what, str | None, "names with commas between", "write for example 'offset,roll'")
    checks.kind("others", others, Sequence, "a list of Scans")
    for other in others:
        check_scan(other, "others")
    shape = None if phantom is None else load_beads(Path(phantom))
    return run_calibration(scan, runtime_of(device), what, others, phantom=shape, splines=splines)


@naming_arguments()
def move_views(scan: Scan, views: np.ndarray, *, without_gauges: bool = False) -> Scan:
    """Returns the scan with the same frames and other poses of its views.

    views: (F, 3), for each view the gantry's turn about the axis in rad, counterclockwise seen from above, and the panel's
    shifts along v and u in mm. They hold for all times of a view. without_gauges: leaves out the part of ``views`` that a
    turned or shifted object explains as well (docs/calibrate.md). If frames overlap in time, ``save_scan`` refuses the
    result, because a file has one pose at a time. If exposures touch, it stores them two billionths shorter.

    Raises InputError for anything but a Scan, and for ``views`` of another shape or with numbers that are not finite."""
    check_scan(scan)
    checks.flag("without_gauges", without_gauges)
    numbers = checks.numbers("views", views, (scan.frames, 3))
    if without_gauges:
        numbers = WobbleParameters.of(scan).without_gauges(numbers)
    return perturb(scan, GeometryCorrection(), Views(numbers[:, 0], numbers[:, 1:]))


@naming_arguments()
def pose_gradient(
    scan: Scan, x: Gaussians | np.ndarray, by_frames: np.ndarray, motion: str | Motion | None = None, *,
    device: Device = None,
) -> np.ndarray:
    """Returns the derivative (F, 3) float64 of a loss by the ``views`` of ``move_views``, per rad and mm (Choi et al. 2026).

    x: the object. ``Gaussians`` are differentiated by the chain rule, through the poses of every line; a volume (nz, ny, nx)
    in 1/mm on the scan's grid, by central differences of 1/4 pixel. by_frames (F, rows, columns): the loss' derivative
    by the frames; for half the squared misfit, frames of x minus frames of the scan. Exposures average line integrals,
    whatever the scan's detector model. motion: as in ``splat_operator`` or ``ray_operator``. device: what ``--device``
    takes, or a Runtime.

    Raises InputError as the operators do."""
    check_scan(scan)
    checks.numbers("by_frames", by_frames, scan.projections.shape)
    if isinstance(x, Gaussians):
        in_pixels = splat_operator(scan, motion or "exact", device=device).by_poses(x, by_frames)
        return in_pixels / np.array([1.0, *scan.geometry.pixel_size_mm])
    if np.shape(x)[:1] == (ROWS,) and np.ndim(x) == 2:
        raise InputError("x", f"shape {np.shape(x)}", "Gaussians or a volume", "of rows (11, G): Gaussians.from_rows(rows)")
    checks.numbers("x", x, scan.grid.shape)
    gradient, units = np.zeros((scan.frames, 3)), units_of_views(scan) * _STEP_PX
    for kind, unit in enumerate(units):
        for sign in (1, -1):
            step = np.zeros((scan.frames, 3))
            step[:, kind] = sign * unit
            frames = ray_operator(move_views(scan, step), motion or "per-row", device=device)(x)
            gradient[:, kind] += sign / (2 * unit) * np.einsum("fvu,fvu->f", frames, by_frames, dtype=np.float64)
    return gradient
