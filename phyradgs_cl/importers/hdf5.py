"""What formats in HDF5 share: reads the beam, and arrays at addresses that the format, options or a TOML file state."""

import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from phyradgs_cl.acquisition.geometry import Geometry
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.assemble import DISTANCES, Turned, cone, parallel
from phyradgs_cl.importers.files import SafeFolder
from phyradgs_cl.importers.frames import LineIntegrals, Moments, line_integrals, oriented
from phyradgs_cl.importers.options import ImportOptions
from phyradgs_cl.io import scan as schema
from phyradgs_cl.io.hdf5 import Hdf5Source, open_hdf5
from phyradgs_cl.io.hdf5 import datasets as h5
from phyradgs_cl.io.hdf5.datasets import ANGLE, LENGTH
from phyradgs_cl.io.scan.header import read_duration, taken_at
from phyradgs_cl.io.scan.reader import united

_log = logging.getLogger(__name__)
STACKS = ("projections", "flats", "darks", "mask")
NAMES = (*STACKS, "image_key", "angles", "monitor", "axes")
AXES = ["frame", "v", "u"]
_LIKE = 0.1  # a larger relative difference between pixels on the panel and pixels at the sample × magnification is a warning
_LEAST_MM = 1e-4  # no pixel is smaller than this: a smaller number without a unit must be in m
_MAGNIFICATION = re.compile(r"(\d+(?:\.\d+)?)\s*[x×]|^(\d+(?:\.\d+)?)$", re.I)  # 10, 10x, 7.5 X/0.2
_FAR = 0.9e6  # a source as many pixels away, or more, is too far for a cone beam: ``geometry.check_distances``
_FAN = 0.5  # pixels by which rays of a far source may miss those of a parallel beam at the object's rim


def is_address(text: object) -> bool:
    """Returns whether ``text`` has the form FILE:/ADDRESS of an array in an HDF5 file."""
    return isinstance(text, str) and text.rpartition(":/")[0] != ""


@dataclass(frozen=True, eq=False)
class Places:
    """The addresses in HDF5 of a scan's arrays.

    - stated: for each array (one of ``NAMES``), a list of FILE:/ADDRESS, or of /ADDRESS in ``source``. A FILE that does not
      exist is sought beside ``source``. Instead of addresses, "axes" has the order of the frames' axes. subject: what states
      the addresses, for messages.
    - linked_folder: see ``open_hdf5``. folder: the only folder from which files are read; None allows any."""

    stated: Mapping[str, Sequence[str]]
    subject: str
    linked_folder: Path | None
    source: Hdf5Source | None = None
    folder: SafeFolder | None = None

    @contextmanager
    def opened(self, name: str, text: str) -> Iterator[tuple[Hdf5Source, str]]:
        """Yields the open file and the address in it. text: FILE:/ADDRESS or /ADDRESS of the array ``name``. Raises
        InputError for other texts."""
        file, _, address = text.rpartition(":/")
        subject = f"{self.subject} {name}"
        if self.source is not None and not file and text.startswith("/"):
            yield self.source, text
            return
        if not file:
            expected, remedy = "an address in HDF5, as FILE:/ADDRESS", "'h5ls -r FILE' lists them"
            raise InputError(subject, repr(text)[:80], expected, remedy)
        path = Path(file) if self.folder is None else self.folder.file(file, subject)
        if self.source is not None and not path.exists():
            path = self.source.path.parent / file
        with open_hdf5(path, self.linked_folder) as other:
            yield other, f"/{address}"

    def _at(self, name: str, usual: Sequence[str]) -> Sequence[str]:
        """Returns the stated addresses of the array ``name``, else those of ``usual``, the format's, that the file has."""
        there = [address for address in usual if self.source is not None and self.source.find(address) is not None]
        return self.stated.get(name, there)

    def stack(
        self, name: str, usual: Sequence[str] = (), panel: tuple[int, int] | None = None
    ) -> tuple[np.ndarray, dict[str, int]] | None:
        """Reads frames (n, v, u) in their own type from the stated addresses, else from the format's (``usual``). Returns
        them and the number of frames at each address; None if there is no address. Raises InputError for other shapes."""
        stacks: dict[str, np.ndarray] = {}
        for text in self._at(name, usual):
            with self.opened(name, str(text)) as (source, address):
                stacks[text] = self._read(source, address, panel)
        if not stacks:
            return None
        parts = list(stacks.values())
        return (parts[0] if len(parts) == 1 else np.concatenate(parts)), {text: len(one) for text, one in stacks.items()}

    def _read(self, source: Hdf5Source, address: str, panel: tuple[int, int] | None) -> np.ndarray:
        order = self.stated.get("axes", [",".join(AXES)])[0].replace(",", " ").split()
        if sorted(order) != sorted(AXES):
            remedy = "of a stack of sinograms say v,frame,u"
            raise InputError(f"{self.subject} axes", " ".join(order), "frame, v and u in the order of the data", remedy)
        dataset = source.dataset(address)
        long = [count for count in dataset.shape if count != 1]  # a file may have further axes of length 1
        shape = dataset.shape if dataset.ndim <= len(AXES) or len(long) > len(AXES) else tuple(long)
        if len(shape) == len(AXES) - 1 and panel is not None:
            shape = tuple(np.insert(shape, order.index("frame"), 1).tolist())
        if len(shape) != len(AXES) or min(shape) < 1:
            raise source.error(address, f"shape {dataset.shape}", "three axes (frame, v, u), none of them empty")
        values = h5.read_values(source, address, dataset).reshape(shape).transpose([order.index(name) for name in AXES])
        if panel is not None and values.shape[1:] != panel:
            raise source.error(address, f"shape {dataset.shape}", f"(any, {panel[0]}, {panel[1]}), as the projections")
        return values

    def stacks(
        self, projections: str = "/", *, key: Sequence[str] = (), flats: Sequence[str] = (), darks: Sequence[str] = (),
        mask: Sequence[str] = (), times: Sequence[str] = (),
    ) -> "Stacks":
        """Reads all frames from the stated addresses, else from the format's, which are the arguments. key: addresses, the
        first of which in the file has the frames' types (projection, flat, dark, invalid). Separate flats and darks replace
        those among the projections. times: addresses, one of which may have the frames' times. Raises InputError without
        projections, and for arrays that do not fit them."""
        if self.source is not None and "projections" not in self.stated:
            self.source.dataset(projections)  # raises an error if the dataset is missing, and names a similar one
        if (stored := self.stack("projections", [projections])) is None:
            raise InputError(self.subject, "no place of the projections", "one of them")
        frames, panel = stored[0], (stored[0].shape[1], stored[0].shape[2])
        kinds = self._key(key, len(frames))
        used = kinds == schema.PROJECTION
        stacks = {"flats": frames[kinds == schema.FLAT], "darks": frames[kinds == schema.DARK]}
        flats_at = self._moments(times, kinds) if np.any(kinds == schema.FLAT) else None
        for name, addresses in (("flats", flats), ("darks", darks), ("mask", mask)):
            if parts := self.stack(name, addresses, panel):
                stacks[name] = parts[0]
                at = {"pre": -0.5, "post": int(used.sum()) - 0.5}  # flats' times, by the end of their address
                ends = [text.rpartition("_")[2] for text in parts[1]]
                if name == "flats":
                    beside = np.repeat([at.get(end, np.nan) for end in ends], list(parts[1].values()))
                    flats_at = None if np.isnan(beside).any() else (beside, np.arange(int(used.sum())))
        bad = stacks.get("mask")
        if bad is not None and len(bad) not in (1, len(used)):
            raise InputError("mask", f"{len(bad)} images", f"one, or {len(used)} as there are frames")
        if bad is not None:
            bad = None if not bad.any() else bad[0] if len(bad) == 1 else bad[used]
        return Stacks(frames if used.all() else frames[used], stacks["flats"], stacks["darks"], bad, used, flats_at)

    def _moments(self, times: Sequence[str], kinds: np.ndarray) -> Moments:
        """Returns the times of flats and projections at the first of the addresses that has them, else their numbers among
        all stored frames of ``kinds`` (F,)."""
        at = np.arange(len(kinds), dtype=np.float64)
        if self.source is not None:
            found = (taken_at(self.source, address, kinds) for address in times)
            at = next((one for one in found if not np.array_equal(one, at)), at)
        return at[kinds == schema.FLAT], at[kinds == schema.PROJECTION]

    def _key(self, usual: Sequence[str], frames: int) -> np.ndarray:
        """Reads the types (F,) of frames: 0 projection, 1 flat, 2 dark, 3 invalid. Without a key all are projections. Raises
        InputError for other numbers, and where no frame is a projection."""
        for text in self._at("image_key", usual)[:1]:
            with self.opened("image_key", text) as (source, address):
                key = h5.read_shaped(source, address, (frames,))
                key = np.where(key == -1, schema.INVALID, key)  # the nxtomo package writes −1 for alignment frames
                if not np.isin(key, range(schema.INVALID + 1)).all() or not np.any(key == schema.PROJECTION):
                    expected = "0 projection, 1 flat, 2 dark or 3 invalid, and at least one 0"
                    raise source.error(address, f"{np.unique(key)[:5]}", expected)
                return key.astype(np.int64)
        return np.full(frames, schema.PROJECTION)

    def angles_rad(self, used: np.ndarray, options: ImportOptions, usual: str = "", unit: str = "deg") -> np.ndarray:
        """Returns angles in rad, sign as stored, of the frames marked in ``used``, bool (F,). They are at the address in the
        option ``angles``, else at the stated address; else the option itself gives them, else they are at the format's
        address ``usual``. unit: the angles' unit if the file states none."""
        quantity = replace(ANGLE, assumed=unit)
        asked = [options.angles] if options.angles else self.stated.get("angles", ())
        if options.angles and not is_address(options.angles):
            asked = []  # --angles states a range or a text file, which ``options.angle_rad`` reads below
        for text in asked:
            with self.opened("angles", text) as (source, address):
                return h5.read_per_frame(source, address, used, quantity)

        def stored_rad() -> np.ndarray:
            assert self.source is not None
            return h5.read_per_frame(self.source, usual, used, quantity)

        return options.angle_rad(int(used.sum()), stored_rad)

    def per_frame(self, name: str, usual: str, key: Sequence[str], frames: int) -> "Reading | None":
        """Reads a number for each of the stored ``frames``: none without one for each, and none of flats that have other
        addresses. Returns None where no address of the array ``name`` is stated, or none is the word, and the format's
        address (``usual``) is empty. key: see ``stacks``."""
        for text in self._at(name, [usual])[:1]:
            if text == "none":
                return None
            with self.opened(name, text) as (source, address):
                dataset, values = source.dataset(address), np.zeros(frames)
                fits = h5.is_list(dataset, frames) and dataset.dtype.kind in "iuf"
                if fits:
                    values = h5.read_shaped(source, address, (frames,)).astype(np.float64)
                kinds = self._key(key, frames)
                flats = values[(kinds == schema.FLAT) & fits & ("flats" not in self.stated)]
                return Reading(source.name(address), flats, values[(kinds == schema.PROJECTION) & fits])
        return None


class Reading(NamedTuple):
    """A number for each flat (n,) and each projection (P,), such as their exposures; empty arrays where the file has none.
    name: what messages call it."""

    name: str
    flats: np.ndarray
    projections: np.ndarray


@dataclass(frozen=True, eq=False)
class Stacks:
    """Projections (P, v, u), flats and darks (n, v, u), and a mask (v, u) or (P, v, u) that is non-zero at unusable pixels
    (None: use all). used, bool (F,): which stored frames are projections. flats_at: see ``at`` of ``frames.light_of``.
    light (P,): that of the projections' beam over that of the flats'; None: as bright."""

    projections: np.ndarray
    flats: np.ndarray
    darks: np.ndarray
    mask: np.ndarray | None
    used: np.ndarray
    flats_at: Moments | None
    light: np.ndarray | None = None

    @property
    def panel(self) -> tuple[int, int]:
        return self.projections.shape[1], self.projections.shape[2]

    def line_integrals(
        self, subject: str, options: ImportOptions, row_0: str, convention: str | None = None, turn: Turned | None = None
    ) -> LineIntegrals:
        """Returns the projections as line integrals. turn: flips that the file declares. Other arguments: see
        ``frames.line_integrals`` and ``oriented``."""
        frames, flats, darks, bad = (
            None if one is None else oriented(turn.frames(one) if turn else one, options, row_0)
            for one in (self.projections, self.flats, self.darks, self.mask)
        )
        assert frames is not None
        integrals = line_integrals(
            subject, frames, options, flats=flats, darks=darks, convention=convention, flats_at=self.flats_at
        )
        if self.light is not None and (self.light != 1).any():
            integrals = integrals.in_light(self.light)
        return integrals if bad is None else replace(integrals, mask=united(bad != 0, integrals.mask))


def places_of(options: ImportOptions, source: Hdf5Source) -> Places:
    """Returns the addresses that the option ``at`` states. Raises InputError for names that are not in ``NAMES``."""
    stated: dict[str, list[str]] = {}
    subject = options.named("at")
    for text in options.at or ():
        name, sign, value = text.partition("=")
        if name not in NAMES or not sign or not value:
            raise InputError(subject, repr(text)[:80], f"NAME=FILE:/ADDRESS, NAME one of {', '.join(NAMES)}")
        stated.setdefault(name, []).append(value)
    return Places(stated, subject, options.linked_folder, source)


@dataclass(frozen=True)
class Lengths:
    """Addresses of a scan's lengths. source, detector: distances from the axis. at_sample, on_panel: pairs (v, u) of a
    pixel's sides, of which the first that the file has is used. optics: the microscope's magnification, a number or a text;
    the first that the file has is used. binning: how many pixels of the camera are one."""

    source: str
    detector: str
    at_sample: tuple[tuple[str, str], ...]
    on_panel: tuple[tuple[str, str], ...]
    optics: tuple[str, ...] = ()
    binning: tuple[str, ...] = ()


def beam(
    source: Hdf5Source, lengths: Lengths, options: ImportOptions, panel: tuple[int, int], axis_columns: float = 0.0
) -> Geometry:
    """Returns the geometry from the options' numbers, else the file's. If the options give no distance and the file has none
    of the source, the beam is parallel, with a warning. axis_columns: columns from the axis to the panel's middle, positive
    to the right. Raises InputError for wrong lengths."""
    quantity = LENGTH
    for address in (address for pair in (*lengths.at_sample, *lengths.on_panel) for address in pair):
        if source.find(address) is not None and not h5.read_attribute(source, address, "units"):
            pixel = h5.read_values(source, address, source.dataset(address)).ravel()
            if pixel.size and abs(float(pixel[0])) < _LEAST_MM:
                quantity = replace(LENGTH, assumed="m")

    def sides_mm(pairs: Sequence[tuple[str, str]]) -> tuple[float, float] | None:
        for pair in pairs:
            if there := [address for address in pair if source.find(address) is not None]:
                unit = replace(LENGTH, assumed="um") if there[0].endswith("resolution") else quantity
                return h5.read_length(source, there[0], unit), h5.read_length(source, there[-1], unit)
        return None

    def pitch_mm() -> tuple[float, float]:
        """Returns a pixel's sides (v, u) in mm on the equivalent panel without optics, at the detector's distance."""
        at_sample, on_panel = sides_mm(lengths.at_sample), sides_mm(lengths.on_panel)
        if at_sample is None and on_panel is not None and (times := _magnification(source, lengths.optics)):
            at_sample = on_panel[0] / times, on_panel[1] / times
        for address in lengths.binning:
            thing = source.find(address)
            if isinstance(thing, h5py.Dataset) and thing.dtype.kind in "iuf" and thing.size == 1 and np.max(thing[()]) > 1:
                text = "%s is %d and not used: say %s if the file's pixels are those without binning"
                _log.warning(text, source.name(address), np.max(thing[()]), options.named("pixel_size_mm"))
                break
        if at_sample is None or at_sample == on_panel:
            if on_panel is None:
                raise source.error(lengths.on_panel[0][0], "nothing", "a length")
            return on_panel
        widened = at_sample[0] * to_detector_mm / to_axis_mm, at_sample[1] * to_detector_mm / to_axis_mm
        if on_panel is not None and not np.allclose(widened, on_panel, rtol=_LIKE, atol=0):
            text = "%s: pixels of %.4g mm at the sample are taken, not those of %.4g mm on the panel"
            _log.warning(text, source.path, at_sample[1], on_panel[1])
        return widened

    to_axis_mm = to_detector_mm = 1.0
    if not options.given(DISTANCES) and source.find(lengths.source) is None:
        _log.warning("%s: no source distance: a parallel beam", source.name(lengths.source))
        sides = options.taken("pixel_size_mm", pitch_mm)
        return parallel(options, panel, sides, (0.0, axis_columns * sides[1]))
    # abs, since NeXus files state the source's distance as a negative number
    to_axis_mm = options.taken("source_to_axis_mm", lambda: abs(h5.read_number(source, lengths.source, quantity)))
    if to_axis_mm == 0:
        raise source.error(lengths.source, "0", "a length other than 0", "remove it: without one the beam is parallel")
    to_detector_mm = options.taken(
        "source_to_detector_mm", lambda: to_axis_mm + h5.read_length(source, lengths.detector, quantity)
    )
    sides = options.taken("pixel_size_mm", pitch_mm)
    at_axis = sides[0] * to_axis_mm / to_detector_mm, sides[1] * to_axis_mm / to_detector_mm
    if to_axis_mm > _FAR * min(at_axis):
        fan = max((count * side / 2) ** 2 for count, side in zip(panel, at_axis, strict=True)) / to_axis_mm / min(at_axis)
        found = f"a source {to_axis_mm / 1000:.4g} m away, whose fan moves rays by {fan:.2g} pixels at the object's rim"
        if fan > _FAN:
            remedy = "import a TOML that names these arrays, with [source] beam = 'parallel', and bear the blur"
            raise source.error(lengths.source, found, f"at most {_FAN:g} pixels, as a parallel beam has 0", remedy)
        _log.warning("%s: %s: a parallel beam", source.name(lengths.source), found)
        options = replace(options, source_to_axis_mm=None, source_to_detector_mm=None, pixel_size_mm=None)
        return parallel(options, panel, at_axis, (0.0, axis_columns * at_axis[1]))
    return cone(options, to_axis_mm, to_detector_mm, panel, sides, (0.0, axis_columns * sides[1]))


def _magnification(source: Hdf5Source, addresses: Sequence[str]) -> float | None:
    """Returns the first magnification that the file states, as a number or a text; None without one, with a warning where
    something else is stated."""
    for address in [address for address in addresses if source.find(address) is not None][:1]:
        is_number = source.dataset(address).dtype.kind in "iuf"
        text = f"{h5.read_number(source, address):f}" if is_number else h5.read_word(source, address).strip()
        found = _MAGNIFICATION.search(text)
        if found and float(found[1] or found[2]) > 0:
            return float(found[1] or found[2])
        _log.warning("%s is %r, no magnification: the camera's pixels are taken", source.name(address), text)
    return None


def exposure_s(source: Hdf5Source, address: str, used: np.ndarray, options: ImportOptions) -> float | None:
    """Returns the exposure in s of the frames marked in ``used``, bool (F,), or the option that replaces it; None if the
    file has none. If it differs between frames, a fly-scan raises InputError. A scan whose gantry stops needs no exposure:
    the result is then None, with a warning."""
    if options.exposure_s is not None:
        return options.exposure_s if source.find(address) is not None else None
    try:
        return read_duration(source, address, used, needed=False) or None
    except InputError as error:
        if options.frame_time_s is not None:
            raise InputError(error.subject, error.found, error.expected, f"say {options.named('exposure_s')}") from error
        _log.warning("%s: not used, because the gantry stops for every frame", error)
        return None
