"""HDF5 files of beamlines: NXtomo of other programs, and Data Exchange. Options give values that the files lack.

NXtomo does not state which row is on top. Row 0 is taken as the lowest, with a warning, after the flips that the file
declares. The nxtomo package declares flips in two ways, and both are read. The column of the rotation axis becomes a
detector offset. Without a source distance the beam is parallel.

Data Exchange has /exchange with data, data_white, data_dark and theta, of parallel beams; distances from the options make a
cone. Angles are the sample's, in degrees unless the file states other units. Row 0 is the top of the image."""

import logging
from pathlib import Path

import h5py
import numpy as np

from phyradgs_cl.acquisition import CircularOrbit, FrameSweeps, Scan
from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.acquisition.plausible import question_unit
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers import assemble, brightness, hdf5
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.io import scan as schema
from phyradgs_cl.io.hdf5 import Hdf5Source, open_hdf5
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.hdf5.datasets import ANGLE, LENGTH, TIME
from phyradgs_cl.io.scan.header import find_entry, read_duration

_log = logging.getLogger(__name__)
_NOWHERE = "/no entry"  # an address that no file has, for arrays without an entry: options then give all metadata
_EXCHANGE = "/exchange"
_INSTRUMENT = "/measurement/instrument"
_DETECTOR = f"{_INSTRUMENT}/detector"
_OPTICS = tuple(f"{_INSTRUMENT}/{place}objective" for place in ("detection_system/", "", "detector/"))
_FLATS = "/process/acquisition/flat_fields"
# where the acquisition programs of the APS say whether flats have their own exposure, and which
_FLATS_DIFFER = tuple(f"{place}/different_flat_exposure" for place in (_DETECTOR, _FLATS))
_FLAT_EXPOSURES = (
    f"{_DETECTOR}/exposure_time_flat", f"{_FLATS}/flat_exposure_time", f"{_DETECTOR}/brightfield_exposure_time",
)  # fmt: skip
_LENGTHS = hdf5.Lengths(
    source=f"{_INSTRUMENT}/source/distance", detector=f"{_DETECTOR}/distance",
    optics=(*(f"{place}/magnification" for place in _OPTICS), *(f"{place}/camera_objective" for place in _OPTICS)),
    binning=tuple(f"{_DETECTOR}/{name}" for name in ("binning_x", "binning_y", "x_binning", "y_binning")),
    at_sample=(
        (f"{_DETECTOR}/actual_pixel_size_y", f"{_DETECTOR}/actual_pixel_size_x"),
        *((f"{place}/resolution",) * 2 for place in _OPTICS),
    ),
    on_panel=(
        (f"{_DETECTOR}/pixel_size_y", f"{_DETECTOR}/pixel_size_x"),
        (f"{_DETECTOR}/y_pixel_size", f"{_DETECTOR}/x_pixel_size"), (f"{_DETECTOR}/pixel_size",) * 2,
    ),
)  # fmt: skip
_AXES = {"theta": "frame", "y": "v", "x": "u"}
_MOVES = ("x_translation", "y_translation", "z_translation")


def recognises(path: Path) -> bool:
    """Returns whether ``path`` is an HDF5 file without a group /exchange. Raises InputError for a volume of this package."""
    if not path.is_file() or not h5py.is_hdf5(path):
        return False
    with open_hdf5(path) as source:
        if isinstance(source.find(_EXCHANGE), h5py.Group):
            return False
        for member in ("/entry/reconstruction", "/volume"):
            if source.find(member) is not None and source.find("/entry/instrument") is None:
                remedy = "'phyradgs export' writes volumes in other formats, 'phyradgs simulate --volume' projects one"
                raise InputError(f"{path}:{member}", "a volume", "projections with their geometry", remedy)
    return True


def import_scan(path: Path, options: ImportOptions) -> Scan:
    """Imports projections, flats and darks from the file's NXtomo entry, or from the addresses that the options give."""
    with open_hdf5(path, options.linked_folder) as source:
        places = hdf5.places_of(options, source)
        entry = _entry(source, options) if "projections" not in places.stated or options.entry else _NOWHERE
        if source.find(extra := f"{entry}/{schema.EXTRA}") is not None:  # a scan of this package, which needs no import
            raise source.error(extra, "a scan file of this package", "a file of another program", "use it as it is")
        detector = f"{entry}/{schema.DETECTOR}"
        keys = [f"{detector}/{name}" for name in ("image_key_control", "image_key")]
        times = [f"{detector}/{name}" for name in ("frame_start_time", "start_time")]
        stacks = places.stacks(f"{detector}/data", key=keys, mask=[f"{detector}/pixel_mask"], times=times)
        turn = _turned(source, detector)
        columns = 0.0 if options.detector_offset_mm else _axis_columns(source, detector, turn, options)
        geometry = hdf5.beam(source, _lengths(entry), options, stacks.panel, columns)
        timing, trajectory = _motion(places, entry, stacks.used, geometry, options)
        quantity = None
        if "projections" not in places.stated:
            quantity = h5.read_attribute(source, f"{detector}/data", "quantity")
        _refuse_moves(source, entry, stacks.used)
        if (options.quantity or quantity or "counts") == "counts":
            addresses = (("exposures", f"{detector}/count_time"), ("monitor", f"{entry}/control/data"))
            readings = (places.per_frame(name, address, keys, len(stacks.used)) for name, address in addresses)
            exposure, monitor = readings
            stacks = brightness.evened(stacks, exposure, monitor, f"say {options.named('at')} monitor=none")
        title = h5.read_title(source, f"{entry}/title", path.stem)
    if options.row_0 is None:
        text = "%s: row 0 is taken as the lowest, after flips that the file declares; say %s top if the volume is mirrored"
        _log.warning(text, path, options.named("row_0"))
    integrals = stacks.line_integrals(f"{path}:{detector}/data", options, "bottom", quantity, turn)
    return assemble.assemble_scan(integrals, trajectory, geometry, timing, options, path, title=title)


def _entry(source: Hdf5Source, options: ImportOptions) -> str:
    """Returns the address of the NXtomo entry. Raises InputError without one, and says how to state arrays' addresses."""
    with open(source.path, "rb") as file:
        is_matlab = file.read(6) == b"MATLAB"
    try:
        return find_entry(source, options.entry)
    except InputError as error:
        at = options.named("at")
        how = f"say {at} projections=/NAME, and {at} axes=frame,u,v if MATLAB's order is rows, columns, frames"
        if is_matlab:
            raise InputError(str(source.path), "a file of MATLAB", "the address of its frames", how) from error
        remedy = " or ".join(filter(None, (error.remedy, f"say {at} projections=/ADDRESS for arrays elsewhere")))
        raise InputError(error.subject, error.found, error.expected, remedy) from error


def _lengths(entry: str) -> hdf5.Lengths:
    detector, sample = f"{entry}/{schema.DETECTOR}", f"{entry}/{schema.SAMPLE}"

    def pair(name: str) -> tuple[str, str]:
        return name.format("y"), name.format("x")

    return hdf5.Lengths(
        source=f"{entry}/{schema.SOURCE}/distance", detector=f"{detector}/distance",
        at_sample=(pair(f"{sample}/{{}}_pixel_size"), pair(f"{detector}/{{}}_magnified_pixel_size")),
        on_panel=(pair(f"{detector}/{{}}_pixel_size"), (f"{detector}/pixel_size",) * 2),
    )


def _turned(source: Hdf5Source, detector: str) -> assemble.Turned:
    """Reads which image axes are flipped. y_flipped and half turns of the detector about its x axis flip rows; x_flipped and
    half turns about its y axis flip columns. Two flips of one axis cancel."""
    flips = [False, False]
    for index, address in enumerate((f"{detector}/y_flipped", f"{detector}/x_flipped")):
        if source.find(address) is not None:
            flips[index] = bool(np.any(h5.read_values(source, address, source.dataset(address), kinds="biu")))
    for index, name in enumerate(("rx", "ry")):
        address = f"{detector}/transformations/{name}"
        if source.find(address) is not None:
            half_turns = h5.read_number(source, address, ANGLE) / np.pi
            if abs(half_turns - round(half_turns)) > 1e-6:
                raise source.error(address, f"{half_turns * 180:g}°", "0° or 180°: a flip")
            flips[index] ^= bool(round(half_turns) % 2)
    return assemble.Turned(rows=flips[0], columns=flips[1])


def _axis_columns(source: Hdf5Source, detector: str, turn: assemble.Turned, options: ImportOptions) -> float:
    """Returns how many columns the panel's middle lies to the right of the axis; 0 if the file does not state the axis.
    Files of the nxtomo package state the axis' column relative to the panel's middle."""
    names = (f"{detector}/{name}" for name in ("x_rotation_axis_pixel_position", "estimated_cor_from_motor"))
    for address in [address for address in names if source.find(address) is not None][:1]:
        if column := h5.read_number(source, address):
            _log.warning("%s: taken as %g columns from the panel's middle", source.name(address), column)
        return column if turn.columns != (options.column_0 == "right") else -column
    return 0.0


def _motion(
    places: hdf5.Places, entry: str, used: np.ndarray, geometry: Geometry, options: ImportOptions
) -> tuple[assemble.Timing, CircularOrbit]:
    """Reads timing and orbit. used, bool (F,): which frames are projections. ``rotation_angle_end`` has the angle at the end
    of each exposure. Without it, or with angles or a frame time from options, neighbouring frames' angles give the speed."""
    assert places.source is not None
    source, detector, angles = places.source, f"{entry}/{schema.DETECTOR}", f"{entry}/{schema.SAMPLE}/rotation_angle"
    sign = options.gantry_sign(h5.read_attribute(source, angles, "rotates") or "sample")
    angle = sign * places.angles_rad(used, options, angles)
    question_unit(angle, options.called("angles", {"angles": source.name(angles)}), "deg")
    sweeps = source.find(f"{angles}_end") is not None and options.frame_time_s is None and options.angles is None
    start_s = h5.read_per_frame(source, f"{detector}/frame_start_time", used, TIME) if sweeps else None
    stored = assemble.StoredTiming(
        exposure_s=hdf5.exposure_s(source, f"{detector}/count_time", used, options),
        readout_s=read_duration(source, f"{detector}/detector_readout_time", used, needed=False),
        start_s=start_s, angle_at="start" if sweeps else None,
        clock=_clock(source, used, f"{detector}/frame_start_time"),
    )
    timing = assemble.make_timing(source.name(entry), int(used.sum()), options, stored)
    if not sweeps:
        return timing, assemble.turning(geometry, angle, timing)
    last = sign * h5.read_per_frame(source, f"{angles}_end", used, ANGLE)
    sweep = FrameSweeps(timing.start_s, timing.shutter.exposure_s, angle, last)
    return timing, CircularOrbit(geometry, sweep)


def _clock(source: Hdf5Source, used: np.ndarray, *addresses: str) -> str:
    """Returns words for the frame rate at the first address that has numbers: a rate, a time from frame to frame, or the
    times of all frames, of which those ``used``, bool (F,), count."""
    for address in addresses:
        dataset, is_rate = source.find(address), address.endswith("rate")
        if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "iuf" or dataset.size not in (1, used.size):
            continue
        values = h5.read_values(source, address, dataset).astype(np.float64).ravel()
        times = values if values.size == 1 else np.diff(values[used])
        usual = float(np.median(times if is_rate else h5.in_unit(source, address, times, TIME))) if times.size else 0.0
        if np.isfinite(usual) and usual > 0:
            return f"{usual if is_rate else 1 / usual:.6g} frames per second ({source.name(address)})"
    return ""


def _refuse_moves(source: Hdf5Source, entry: str, used: np.ndarray) -> None:
    """Raises InputError for a sample that is shifted between projections, which a circular orbit cannot express."""
    for name in _MOVES:
        address = f"{entry}/{schema.SAMPLE}/{name}"
        if source.find(address) is None or source.dataset(address).size == 1:
            continue
        values = h5.read_per_frame(source, address, used, LENGTH)
        if np.ptp(values) > 0:
            raise source.error(address, f"{values.min():.6g} to {values.max():.6g} mm", "a sample that stays where it is")


def recognises_exchange(path: Path) -> bool:
    """Returns whether ``path`` is an HDF5 file with a group /exchange."""
    if not path.is_file() or not h5py.is_hdf5(path):
        return False
    with open_hdf5(path) as source:
        return isinstance(source.find(_EXCHANGE), h5py.Group)


def import_scan_exchange(path: Path, options: ImportOptions) -> Scan:
    """Imports the projections of /exchange, with the flats and darks taken before and after them."""
    with open_hdf5(path, options.linked_folder) as source:
        places, data, theta = hdf5.places_of(options, source), f"{_EXCHANGE}/data", f"{_EXCHANGE}/theta"
        if "monitor" in places.stated:
            expected, remedy = "none: projections and flats are of separate arrays", "leave it out"
            raise InputError(f"{options.named('at')} monitor", places.stated["monitor"][0], expected, remedy)
        if "axes" not in places.stated and "projections" not in places.stated and source.find(data) is not None:
            axes = np.asarray(source.dataset(data).attrs.get("axes", "")).astype(str).ravel()
            order = [_AXES.get(name, name) for name in ":".join(axes).split(":")]
            if sorted(order) == sorted(hdf5.AXES) and order != hdf5.AXES:
                text = "%s @axes is %s and not used: say %s axes=%s if the data are stored so"
                _log.warning(text, source.name(data), ":".join(axes), options.named("at"), ",".join(order))
        stacks = places.stacks(data, **{
            name: [f"{_EXCHANGE}/data_{kind}{when}" for when in ("", "_pre", "_post")]
            for name, kind in (("flats", "white"), ("darks", "dark"))
        })  # fmt: skip
        if options.angles is None and "angles" not in places.stated and source.find(theta) is None:
            text = "%s: no angles: 0° to 180°, as tomopy.angles has them; say %s FIRST..LAST if the arc is another"
            _log.warning(text, source.name(theta), options.named("angles"))
            theta_rad = np.linspace(0, np.pi, int(stacks.used.sum()))
        else:
            theta_rad = places.angles_rad(stacks.used, options, theta)
            question_unit(theta_rad, options.called("angles", {"angles": source.name(theta)}), "deg")
        geometry = hdf5.beam(source, _LENGTHS, options, stacks.panel)
        stored = assemble.StoredTiming(
            exposure_s=hdf5.exposure_s(source, f"{_DETECTOR}/exposure_time", stacks.used, options),
            clock=_clock(source, stacks.used, f"{_DETECTOR}/acquire_period", f"{_DETECTOR}/frame_rate"),
        )
        if (options.quantity or "counts") == "counts" and options.flat_value is None:
            stacks = brightness.evened(stacks, _flat_exposure(source, stacks), None)
        title = h5.read_title(source, f"{_EXCHANGE}/title", path.stem)
    timing = assemble.make_timing(str(path), len(theta_rad), options, stored)
    integrals = stacks.line_integrals(f"{path}:{data}", options, "top")
    trajectory = assemble.turning(geometry, options.gantry_sign("sample") * theta_rad, timing)
    return assemble.assemble_scan(integrals, trajectory, geometry, timing, options, path, title=title)


def _flat_exposure(source: Hdf5Source, stacks: hdf5.Stacks) -> hdf5.Reading | None:
    """Returns the exposures of flats and projections where the file says that they differ. Raises InputError where it says
    so, and states none of the flats."""
    said = next((address for address in _FLATS_DIFFER if source.find(address) is not None), None)
    if said is None or len(stacks.flats) == 0:
        return None
    if (dataset := source.dataset(said)).dtype.kind in "iu":  # codes of letters
        word = bytes(h5.read_values(source, said, dataset).astype(np.uint8)).decode("latin-1")
    else:
        word = h5.read_word(source, said)
    if word.strip("\0 ").lower() != "different":
        return None
    at = next((address for address in _FLAT_EXPOSURES if source.find(address) is not None), _FLAT_EXPOSURES[1])
    flat_s, frame_s = (h5.read_length(source, address, TIME) for address in (at, f"{_DETECTOR}/exposure_time"))
    return hdf5.Reading(source.name(at), np.full(len(stacks.flats), flat_s), np.full(len(stacks.projections), frame_s))
