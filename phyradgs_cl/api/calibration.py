"""A scan's true geometry and timing, from the scan itself."""

from collections.abc import Sequence
from pathlib import Path

from phyradgs_cl import checks
from phyradgs_cl.acquisition import Scan
from phyradgs_cl.api.devices import Device, runtime_of
from phyradgs_cl.api.runs import check_scan
from phyradgs_cl.calibrate import Calibration
from phyradgs_cl.calibrate import calibrate as run_calibration
from phyradgs_cl.errors import InputError, naming_arguments
from phyradgs_cl.importers import load_beads


@naming_arguments()
def calibrate(
    scan: Scan,
    what: str | None = None,
    *,
    others: Sequence[Scan] = (),
    phantom: str | Path | None = None,
    splines: int = 0,
    device: Device = None,
) -> Calibration:
    """Geometry and timing as the frames tell them (docs/calibrate.md); what they cannot tell stays as stated.

    what: names with commas, ``offset,roll,tilt`` and of a fly-scan ``readout,exposure`` when None; also ``distance``,
    ``start``, ``direction``, ``lag``, ``drift``, ``motion`` and ``wobble`` (views one by one). others: more scans of the
    same object, lying as it did, with the same panel: what is wrong in ``scan`` is taken to be wrong in them. phantom: what
    was scanned, wherever it lies, where that is known: a TOML file of beads and wires (docs/formats.md). splines: of time,
    at least 4, that a ``wobble`` goes by; 0 for every view by itself. device: what ``--device`` takes, or a Runtime.

    The result has ``scan``, corrected; ``parameters``, each with stated, found and deviation in its unit (mm, deg, s, %),
    and a verdict: corrected, agrees, cannot tell; ``alike``, combinations that leave no trace; ``residual_rms`` of line
    integrals before and after; ``before`` and ``after``, those residuals (F, rows, columns) of the coarsened frames;
    ``per_view()``, what was corrected of every view by name and unit (F,); and ``plot()``, a figure of all that.

    Raises InputError for names that there are not, timing of a gantry that stands still, fewer than 8 frames or 12 columns,
    others that do not fit the first, and a phantom that the frames do not show.
    """
    check_scan(scan)
    scan.check_timing()
    if not (what is None or isinstance(what, str)):
        raise InputError("what", checks.shown(what), "names in one text, with commas", "write for example 'offset,roll'")
    if not isinstance(others, Sequence):
        raise InputError("others", checks.shown(others), "a list of Scans")
    for other in others:
        check_scan(other, "others")
    shape = None if phantom is None else load_beads(Path(phantom))
    return run_calibration(scan, runtime_of(device), what, others, phantom=shape, splines=splines)
