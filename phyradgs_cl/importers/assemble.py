"""The last step of every importer: line integrals, trajectory, geometry, timing and options make a scan."""

from collections.abc import Mapping

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, ParallelGeometry, PoseTable, Scan
from phyradgs_cl.acquisition.geometry import Geometry, default_grid
from phyradgs_cl.acquisition.plausible import check_plausible
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers.motion import Timing
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.reading.frames import LineIntegrals


def assemble_scan(
    integrals: LineIntegrals, trajectory: CircularOrbit | PoseTable, geometry: Geometry, timing: Timing,
    options: ImportOptions, *, title: str, source: str, grid: Grid | None = None,
    reference: np.ndarray | None = None, lag: float = 0.0, names: Mapping[str, str] | None = None,
) -> Scan:
    """Returns the scan of line integrals with row 0 the lowest; without a grid it gets the cone's cube. ``names``: names in
    messages about implausible values that a file states. InputError for such values."""
    assumed = [*timing.assumed, *([] if options.detector_model else ["average"])] if timing.is_fly else []
    scan = Scan(
        projections=integrals.values,
        geometry=geometry,
        trajectory=trajectory,
        shutter=timing.shutter,
        frame_start_s=np.asarray(timing.start_s, np.float64),
        grid=grid or default_grid(geometry),
        is_fly=timing.is_fly,
        detector_model=options.detector_model or "log",
        pixel_mask=integrals.mask,
        reference=reference,
        title=title,
        provenance={"imported_from": source, **integrals.applied, **({"assumed": assumed} if assumed else {})},
        lag=lag,
        saturation=integrals.saturation,
    )
    subjects = {"grid": f"{source} grid", "angles": f"{source} angles", **(names or {})}
    is_timed = "exposure" not in assumed  # by convention an exposure of 1 s: the frame rate means nothing then
    check_plausible(scan, lambda name: subjects.get(name) or options.called(name), is_timed)
    scan.warn_of_near_panel()
    return scan


def parallel(
    options: ImportOptions, panel: tuple[int, int], pitch_mm: tuple[float, float], offset_mm: tuple[float, float]
) -> ParallelGeometry:
    """Returns a parallel beam of a file's numbers, or the options' where they are given. InputError for distances."""
    for name in ("source_to_axis_mm", "source_to_detector_mm"):
        if getattr(options, name) is not None:
            expected, remedy = "no distance: this file has a parallel beam", "leave it out"
            raise InputError(options.named(name), f"{getattr(options, name):g}", expected, remedy)
    return ParallelGeometry(panel, options.pixel_size_mm or pitch_mm, options.detector_offset_mm or offset_mm)


def cone(
    options: ImportOptions, to_axis_mm: float, to_detector_mm: float, panel: tuple[int, int],
    pitch_mm: tuple[float, ...], offset_mm: tuple[float, float],
) -> Geometry:
    """Returns a geometry of a file's numbers, or the options' where they are given. InputError unless the panel stands
    behind the axis."""
    to_axis_mm = options.source_to_axis_mm or to_axis_mm
    to_detector_mm = options.source_to_detector_mm or to_detector_mm
    if to_detector_mm <= to_axis_mm:
        expected = f"more than {options.named('source_to_axis_mm')} ({to_axis_mm:g})"
        subject = options.named("source_to_detector_mm")
        raise InputError(subject, f"{to_detector_mm:g}", expected, "are the two exchanged?")
    dv, du = options.pixel_size_mm or pitch_mm
    return ConeGeometry(to_axis_mm, to_detector_mm, panel, (dv, du), options.detector_offset_mm or offset_mm)
