"""Data Exchange files (HDF5) of synchrotron beamlines: /exchange with data, data_white, data_dark and theta. The format
describes parallel beams, which files without a source distance have; distances from the options make a cone. Pixel sizes may
come from the options too. Angles are the sample's, in degrees unless units differ; row 0 is the top of the image."""

import logging
from pathlib import Path

import h5py
import numpy as np

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.importers import hdf5
from phyradgs_cl.importers.assemble import StoredTiming, assemble_scan, make_timing, turning
from phyradgs_cl.importers.options import OF_HDF5, ImportOptions
from phyradgs_cl.importers.reading.frames import gantry_sign
from phyradgs_cl.io.hdf5.datasets import read_title
from phyradgs_cl.io.hdf5.source import open_hdf5

_log = logging.getLogger(__name__)
_EXCHANGE = "/exchange"
_INSTRUMENT = "/measurement/instrument"
_DETECTOR, _OPTICS = f"{_INSTRUMENT}/detector", f"{_INSTRUMENT}/detection_system/objective"
_LENGTHS = hdf5.Lengths(
    source=f"{_INSTRUMENT}/source/distance", detector=f"{_DETECTOR}/distance", optics=f"{_OPTICS}/magnification",
    at_sample=(
        (f"{_DETECTOR}/actual_pixel_size_y", f"{_DETECTOR}/actual_pixel_size_x"),
        *((f"{place}/resolution",) * 2 for place in (_OPTICS, f"{_INSTRUMENT}/objective")),
    ),
    on_panel=(
        (f"{_DETECTOR}/pixel_size_y", f"{_DETECTOR}/pixel_size_x"),
        (f"{_DETECTOR}/y_pixel_size", f"{_DETECTOR}/x_pixel_size"), (f"{_DETECTOR}/pixel_size",) * 2,
    ),
)  # fmt: skip


def recognises(path: Path) -> bool:
    """True for an HDF5 file with a group /exchange."""
    if not path.is_file() or not h5py.is_hdf5(path):
        return False
    with open_hdf5(path) as source:
        return isinstance(source.find(_EXCHANGE), h5py.Group)


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports the projections of /exchange, with its flats and darks before and after."""
    options.refuse_unused("data-exchange", OF_HDF5)
    with open_hdf5(path, options.linked_folder) as source:
        places, theta = hdf5.places_of(options, source), f"{_EXCHANGE}/theta"
        stacks = places.stacks(f"{_EXCHANGE}/data", **{
            name: [f"{_EXCHANGE}/data_{kind}{when}" for when in ("", "_pre", "_post")]
            for name, kind in (("flats", "white"), ("darks", "dark"))
        })  # fmt: skip
        if options.angles is None and "angles" not in places.stated and source.find(theta) is None:
            text = "%s: no angles: 0° to 180°, as tomopy.angles has them; say %s FIRST..LAST if the arc is another"
            _log.warning(text, source.name(theta), options.named("angles"))
            theta_rad = np.linspace(0, np.pi, int(stacks.used.sum()))
        else:
            theta_rad = places.angles_rad(stacks.used, options, theta)
        geometry = hdf5.beam(source, _LENGTHS, options, stacks.panel)
        exposure_s = hdf5.exposure_s(source, f"{_DETECTOR}/exposure_time", stacks.used, options)
        title = read_title(source, f"{_EXCHANGE}/title", path.stem)
    timing = make_timing(str(path), len(theta_rad), options, StoredTiming(exposure_s=exposure_s))
    integrals = stacks.line_integrals(f"{path}:{_EXCHANGE}/data", options, "top")
    trajectory = turning(geometry, gantry_sign(options, "sample") * theta_rad, timing)
    return assemble_scan(integrals, trajectory, geometry, timing, options, title=title, source=str(path))
