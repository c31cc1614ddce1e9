"""Changes to a scan before any method sees it: another grid, lag removal, the steps of ``prepare``."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
import scipy

from phyradgs_cl import checks
from phyradgs_cl.acquisition import LineMiddles, PerRow, Scan
from phyradgs_cl.acquisition.motion import with_times
from phyradgs_cl.detector import without_lag
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import GridChoice
from phyradgs_cl.prepare import STEP_FIELDS, Model, PrepareOptions, prepare
from phyradgs_cl.prepare.chain import one_by_one
from phyradgs_cl.prepare.step import Facts
from phyradgs_cl.runtime import Runtime
from phyradgs_cl.text import each_warning_once, flag_of

MOST_HELD_OUT = 50.0  # largest percentage of pixels that ``holdout`` may hide
_HOLDOUT = "Pixels hidden from the method, to measure its error on them."
_DOUBT = "Run twice more, for an error bar of every voxel: dataset doubt of the volume file (docs: methods.md)."


@dataclass(frozen=True)
class Preprocessing(PrepareOptions, GridChoice):
    """Options of what happens to a scan before the method reconstructs it.

    - size, voxel_mm, roi_mm, margin_mm: the grid, as in ``GridChoice``. ignore_lag: leave the panel's lag in the frames.
    - holdout: percentage of the pixels that the method does not use, to measure its error on them.
    - doubt: run the method also on two scans that are made from this one, for error bars of voxels.
    - steps, and a table for each: as in ``PrepareOptions``."""

    ignore_lag: bool = False
    holdout: float = checks.option(0.0, _HOLDOUT, "0", metavar="PERCENT", range=(0, MOST_HELD_OUT), of_method=True)
    doubt: bool = checks.option(False, _DOUBT, of_method=True)

    def __post_init__(self) -> None:
        GridChoice.__post_init__(self)
        PrepareOptions.__post_init__(self)

    def facts(self) -> dict[str, object]:
        """Returns ``ignore_lag``, and the other options that differ from their defaults, by name."""
        own = {f.name: (getattr(self, f.name), f.default) for f in fields(self) if f.name not in STEP_FIELDS}
        stated = {name: value for name, (value, usual) in own.items() if name == "ignore_lag" or value != usual}
        return {**stated, **self.step_facts()}

    def check_written(self) -> None:
        """Raises InputError if ``holdout`` or ``doubt`` is set: both need a method, but the scan is only to be written."""
        for one in (one for one in fields(self) if "of_method" in one.metadata and getattr(self, one.name)):
            found, remedy = "a scan that is prepared, without a method", "give it to the reconstruction instead"
            raise InputError(flag_of(one.name), found, "a reconstruction", remedy)


@each_warning_once()
def prepared(scan: Scan, options: Preprocessing, rt: Runtime | None = None) -> Scan:
    """Returns the prepared scan, on the grid of ``options`` with its margin; the scan itself if there is nothing to do.

    ``rt``: the device for the steps that reconstruct and project. These steps raise InputError if ``rt`` is None."""
    return prepare(regrid_and_remove_lag(scan, options), options, partial(reprojection, rt))


def stages(scan: Scan, options: Preprocessing, rt: Runtime) -> Iterator[tuple[str, Scan, Facts]]:
    """Yields (name, scan, numbers): ("", scan before the steps of ``options``, {}), then each step's name, scan, numbers."""
    scan = regrid_and_remove_lag(scan, options)
    yield "", scan, {}
    yield from one_by_one(scan, options, partial(reprojection, rt))


def regrid_and_remove_lag(scan: Scan, options: Preprocessing) -> Scan:
    """Returns the scan on the grid of ``options`` with its margin, and without the panel's lag unless ``ignore_lag``."""
    scan = scan.with_grid(options)
    scan = scan.on_grid(options.with_margin(scan.grid))
    return scan if options.ignore_lag else without_lag(scan)


def reprojection(rt: Runtime | None, scan: Scan) -> Model:
    """Returns the functions with which ``prepare`` reconstructs and projects frames. Raises InputError if ``rt`` is None."""
    if rt is None:
        raise InputError("--steps", "a step that reconstructs, without a device", "a Runtime", "pass one")
    from phyradgs_cl.operators import RayOperator  # imported here because methods are slow to import
    from phyradgs_cl.operators.rays.subrays import subrays_of
    from phyradgs_cl.reconstructors.fdk import FbpOptions, FdkOptions, fdk
    from phyradgs_cl.reconstructors.voxels import fista_tv

    motion = LineMiddles()
    fdk_options = (FbpOptions if scan.is_parallel else FdkOptions)(window="hann", motion=motion)
    tv_options = fista_tv.FistaTvOptions(motion=PerRow(sub_intervals=2), iterations=30, tv_weight=0.002)
    tables = [motion.cells(scan, frame).still() for frame in range(scan.frames)]
    operator = RayOperator(rt, scan.grid, scan.geometry.detector_shape, tables, subrays=subrays_of(scan.grid, tables))

    def of(frames: np.ndarray) -> Scan:
        return replace(scan, projections=np.asarray(frames, np.float32))

    def shadow(inside: np.ndarray) -> np.ndarray:
        moving = with_times(PerRow(), scan)
        cells = [moving.cells(scan, frame) for frame in range(scan.frames)]
        whole = RayOperator(rt, scan.grid, scan.geometry.detector_shape, cells, subrays=subrays_of(scan.grid, cells))
        near = scipy.ndimage.binary_dilation(inside)  # rays that graze a voxel, or meet it between two times, count too
        return whole.forward(near.astype(np.float32)) > 0

    return Model(
        shadow=shadow, volume=lambda frames: fdk(of(frames), fdk_options, rt).volume, frames=operator.forward,
        regularised=lambda frames: fista_tv.METHOD.run(of(frames), tv_options, rt).complete().volume,
    )
