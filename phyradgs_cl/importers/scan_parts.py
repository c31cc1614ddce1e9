"""The last step of every importer: parts of a scan put together, with what the user says over them."""

from dataclasses import replace
from typing import Any

import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, ConeGeometry, PoseTable, Scan
from phyradgs_cl.errors import InputError
from phyradgs_cl.fields import Grid
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.importers.reading.frames import LineIntegrals
from phyradgs_cl.importers.timing import Timing
from phyradgs_cl.io import default_grid


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
) -> Scan:
    """A scan of line integrals, row 0 the lowest already; the grid is the cone's cube where none is given."""
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
        provenance={"imported_from": source, **integrals.applied},
        lag=lag,
        saturation=integrals.saturation,
    )
    scan.warn_of_near_panel()
    return scan


def with_options(geometry: ConeGeometry, options: ImportOptions) -> ConeGeometry:
    """The geometry with the distances, pitches and offset that the user gives in place of the file's."""
    changes: dict[str, Any] = {
        "source_to_axis_mm": options.source_to_axis_mm,
        "source_to_detector_mm": options.source_to_detector_mm,
        "pixel_size_mm": options.pixel_size_mm,
        "detector_offset_mm": options.detector_offset_mm,
    }
    return checked(replace(geometry, **{k: v for k, v in changes.items() if v is not None}))


def checked(geometry: ConeGeometry) -> ConeGeometry:
    """InputError unless the detector stands behind the axis."""
    to_axis, to_detector = geometry.source_to_axis_mm, geometry.source_to_detector_mm
    if to_detector <= to_axis:
        expected = f"more than the distance to the axis ({to_axis:g} mm)"
        raise InputError("source-to-detector distance", f"{to_detector:g} mm", expected)
    return geometry
