"""The last step of every importer: parts of a scan put together, with what the user says over them."""

from collections.abc import Mapping

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, PoseTable, Scan
from phyradgs_cl.acquisition.geometry import default_grid
from phyradgs_cl.acquisition.plausible import check_plausible
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.reading.frames import LineIntegrals
from phyradgs_cl.importers.timing import Timing


def put_together(
    integrals: LineIntegrals,
    trajectory: CircularOrbit | PoseTable,
    geometry: ConeGeometry,
    timing: Timing,
    options: ImportOptions,
    *,
    title: str,
    source: str,
    grid: Grid | None = None,
    reference: np.ndarray | None = None,
    lag: float = 0.0,
    names: Mapping[str, str] | None = None,
) -> Scan:
    """A scan of line integrals, row 0 the lowest already; the grid is the cone's cube where none is given. ``names``: how
    messages about implausible values call what a file states. InputError for such values."""
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
    scan.warn_of_near_panel()
    subjects = {"grid": f"{source} grid", "angles": f"{source} angles", **(names or {})}
    check_plausible(scan, lambda name: subjects.get(name) or options.called(name))
    return scan


def with_options(geometry: ConeGeometry, options: ImportOptions) -> ConeGeometry:
    """The geometry with the distances, pitches and offset that the user gives in place of the file's."""
    own = geometry.source_to_axis_mm, geometry.source_to_detector_mm
    return cone(options, *own, geometry.detector_shape, geometry.pixel_size_mm, geometry.detector_offset_mm)


def cone(
    options: ImportOptions,
    to_axis_mm: float,
    to_detector_mm: float,
    panel: tuple[int, int],
    pitch_mm: tuple[float, ...],
    offset_mm: tuple[float, float],
) -> ConeGeometry:
    """A geometry of a file's numbers, over which the options win. InputError unless the panel stands behind the axis."""
    to_axis_mm = options.source_to_axis_mm or to_axis_mm
    to_detector_mm = options.source_to_detector_mm or to_detector_mm
    if to_detector_mm <= to_axis_mm:
        expected = f"more than {options.named('source_to_axis_mm')} ({to_axis_mm:g})"
        subject = options.named("source_to_detector_mm")
        raise InputError(subject, f"{to_detector_mm:g}", expected, "are the two exchanged?")
    dv, du = options.pixel_size_mm or pitch_mm
    return ConeGeometry(to_axis_mm, to_detector_mm, panel, (dv, du), options.detector_offset_mm or offset_mm)
