"""Data Exchange files (HDF5) of synchrotron beamlines: /exchange with data, data_white, data_dark and theta. The format
describes parallel beams, which files without a source distance have; distances from the options make a cone. Pixel sizes may
come from the options too. Angles are the sample's, in degrees unless units differ; row 0 is the top of the image."""

from pathlib import Path

import h5py

from phyradgs_cl.acquisition import Scan
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.importers.assemble import StoredTiming, assemble_scan, make_timing, stored_beam, turning
from phyradgs_cl.importers.options import OF_BARE_FRAMES, ImportOptions
from phyradgs_cl.importers.reading import frames as reading
from phyradgs_cl.importers.reading.frames import line_integrals, oriented
from phyradgs_cl.io.hdf5.datasets import ANGLE, TIME, read_array, read_title
from phyradgs_cl.io.hdf5.source import Hdf5Source, open_hdf5

_EXCHANGE = "/exchange"
_INSTRUMENT = "/measurement/instrument"
_DETECTOR = f"{_INSTRUMENT}/detector"


def recognises(path: Path) -> bool:
    """True for an HDF5 file with a group /exchange."""
    if not path.is_file() or not h5py.is_hdf5(path):
        return False
    with open_hdf5(path) as source:
        return isinstance(source.find(_EXCHANGE), h5py.Group)


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports the projections of /exchange, with its flats and darks."""
    options.refuse_unused("data-exchange", OF_BARE_FRAMES)
    with open_hdf5(path) as source:
        frames = reading.read_frames(source, f"{_EXCHANGE}/data")
        panel = (frames.shape[1], frames.shape[2])
        places = {name: f"{_EXCHANGE}/data_{name}" for name in ("white", "dark")}
        there = {name: address for name, address in places.items() if source.find(address) is not None}
        stacks = {name: reading.read_frames(source, there[name], panel) for name in there}
        theta_rad = read_array(source, f"{_EXCHANGE}/theta", (len(frames),), ANGLE)
        geometry = _geometry(source, panel, options)
        exposure_s = reading.optional_length(source, f"{_DETECTOR}/exposure_time", quantity=TIME)
        title = read_title(source, f"{_EXCHANGE}/title", path.stem)
    timing = make_timing(str(path), len(frames), options, StoredTiming(exposure_s=exposure_s))
    turned = {name: oriented(stack, options, "top") for name, stack in stacks.items()}
    subject, flats, darks = f"{path}:{_EXCHANGE}/data", turned.get("white"), turned.get("dark")
    integrals = line_integrals(subject, oriented(frames, options, "top"), options, flats=flats, darks=darks)
    trajectory = turning(geometry, reading.gantry_sign(options, "sample") * theta_rad, timing)
    return assemble_scan(integrals, trajectory, geometry, timing, options, title=title, source=str(path))


def _geometry(source: Hdf5Source, panel: tuple[int, int], options: ImportOptions) -> Geometry:
    address = f"{_INSTRUMENT}/source/distance"
    to_axis_mm = options.source_to_axis_mm or reading.optional_length(source, address)
    pitch = options.pixel_size_mm or (
        reading.stored_pitch(source, options, f"{_DETECTOR}/pixel_size_y", f"{_DETECTOR}/y_pixel_size"),
        reading.stored_pitch(source, options, f"{_DETECTOR}/pixel_size_x", f"{_DETECTOR}/x_pixel_size"),
    )
    return stored_beam(source, (address, f"{_DETECTOR}/distance"), to_axis_mm, options, panel, pitch)
