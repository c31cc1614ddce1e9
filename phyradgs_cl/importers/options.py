"""Options of an import: values that a foreign scan's files do not state, or that replace theirs."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from phyradgs_cl import checks
from phyradgs_cl.acquisition.readout import SIDES, Named, frame_time_of, readout_order, seconds_of
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.errors import InputError
from phyradgs_cl.importers.angles import read_angles_rad
from phyradgs_cl.io.files import regular_file
from phyradgs_cl.text import flag_of

T = TypeVar("T")
_FILE, _FORMAT = "the file's", "the format's"
DETECTOR_OFFSET = "Shift V,U of the panel's centre, mm: V > 0 up (rows), U > 0 right (columns), seen from the source."
_AT = (
    "An array in HDF5: NAME=FILE:/ADDRESS or NAME=/ADDRESS. NAME: projections, flats, darks, mask, image_key, angles, "
    "monitor (none: without it); axes=v,frame,u: their order."
)
_STEPS = re.compile(r"\s*([-+]?\d+(?:\.\d+)?)\s*(,|\.\.)\s*([-+]?\d+(?:\.\d+)?)\s*")
_ANGLE_AT = "A frame's angle: at its first line's start or middle."
_ANGLES = "Angles in degrees: a text file, FIRST,STEP or FIRST..LAST."
_FRAMES = "Where a description states more frames than there are: refuse (stated), or take those found."
_FLATS = "Flats: their median, or interpolated in time."
_MODEL = "An exposure averages line integrals (log) or intensity."
_PART = "Projections of a benchmark folder (r2, phyradgs, naf)."
_FIRST_VIEW = "First view of this scan in a JSON of several (phyradgs-real)."


def _option(help: str, usual: str | bool = _FILE, default: Any = None, **known: Any) -> Any:
    return checks.option(default, help, usual, **known)


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import. None leaves a value to the file or to the format's convention. Readout axis and direction are
    those of the imported scan: row 0 the lowest, column 0 on the left, seen from the source.

    Users may also give timing as data sheets do: ``first``, ``fps``, ``exposure_ms`` and ``readout_ms``. Readout axis and
    direction, ``frame_time_s``, ``exposure_s`` and ``readout_s`` are computed from these. named: the function that returns
    a field's name for messages. Raises InputError for values out of range, and for contradictions."""

    exposure_s: float | None = _option("Exposure of a line, s, in place of --exposure-ms.", range=(0, 1e6))
    readout_s: float | None = checks.option(None, range=(0, 1e6))
    frame_time_s: float | None = checks.option(None, is_positive=True)
    angle_at: str | None = _option(_ANGLE_AT, "start", words=("start", "middle"))
    readout_axis: str | None = checks.option(None, words=AXES)
    readout_direction: int | None = checks.option(None, words=(1, -1))
    source_to_axis_mm: float | None = _option("Source to rotation axis, mm.", is_positive=True)
    source_to_detector_mm: float | None = _option("Source to detector, mm.", is_positive=True)
    pixel_size_mm: tuple[float, float] | None = _option("Pixel's side, or height and width, mm.", is_positive=True)
    detector_offset_mm: tuple[float, float] | None = _option(DETECTOR_OFFSET, range=(-1e6, 1e6), flag="--detector-offset")
    unit_mm: float = _option("Length of a scene unit in mm (r2, phyradgs).", True, 1.0, is_positive=True)
    rotates: str | None = _option("The part that the stored angles turn.", _FORMAT, words=("gantry", "sample"))
    row_0: str | None = _option("Place of the first stored row.", _FORMAT, words=("top", "bottom"))
    column_0: str | None = _option("Place of the first stored column.", "left", words=("left", "right"))
    quantity: str | None = _option("Quantity in the pixels.", words=("attenuation", "transmission", "counts"))
    angles: str | None = _option(_ANGLES)
    frames: str | None = _option(_FRAMES, "stated", words=("stated", "found"))
    flats: str | None = _option(_FLATS, "time if the file states it, else median", words=("median", "time"))
    flat_value: float | None = _option("Counts without an object, in place of flat frames.", is_positive=True)
    detector_model: str | None = _option(_MODEL, "log", words=DETECTOR_MODELS)
    part: str = _option(_PART, True, "train", words=("train", "test", "all"))
    first_view: int | None = _option(_FIRST_VIEW, "all", range=(0, 1e6))
    first: str | None = _option("Line that is read first, seen from the source.", _FORMAT, words=SIDES)
    fps: float | None = _option("Frames per second of a gantry that never stops.", f"{_FILE}, else at rest")
    exposure_ms: float | None = _option("Exposure of a line, ms.")
    readout_ms: float | None = _option("From the first line's opening to the last line's, ms.")
    entry: str | None = _option("Address of the scan in an HDF5 file of several, as /entry1/tomo_entry.")
    at: tuple[str, ...] | None = _option(_AT, _FORMAT, kind=list[str])
    linked_folder: Path | None = _option("Folder with the files that an HDF5 file links to.", "that of SRC")
    named: Named = field(default=str, repr=False, compare=False)

    def __post_init__(self) -> None:
        checks.fields_within(self.named, self)
        axis, direction = readout_order(self.first, self.readout_axis, self.readout_direction, self.named)
        stated = {  # these fields are what importers read, computed from the options given
            "readout_axis": axis, "readout_direction": direction,
            "frame_time_s": frame_time_of(self.fps, self.frame_time_s, self.named),
            "exposure_s": seconds_of("exposure", self.exposure_ms, self.exposure_s, self.named),
            "readout_s": seconds_of("readout", self.readout_ms, self.readout_s, self.named),
        }
        for name, value in stated.items():
            object.__setattr__(self, name, value)

    def given(self, among: tuple[str, ...]) -> list[str]:
        return [name for name in among if getattr(self, name) != _DEFAULTS[name]]

    def taken(self, name: str, stored: Callable[[], T]) -> T:
        """Returns the option ``name`` if given, else what ``stored`` reads from the file, or ``stored`` itself if it is no
        function. If reading raises InputError, the error's remedy names the option."""
        value: T | None = getattr(self, name)
        if value is not None:
            return value
        try:
            return stored() if callable(stored) else stored
        except InputError as error:
            remedy = f"{error.remedy}, or say {self.named(name)}" if error.remedy else f"say {self.named(name)}"
            raise InputError(error.subject, error.found, error.expected, remedy) from error

    def angle_rad(self, count: int, stored: Callable[[], np.ndarray]) -> np.ndarray:
        """Returns angles (count,) in rad, from the option ``angles``, else those that ``stored`` reads."""
        if self.angles is None:
            return self.taken("angles", stored)
        if not (steps := _STEPS.fullmatch(self.angles)):
            regular_file(path := Path(self.angles), self.named("angles"))
            return read_angles_rad(path, count)
        first, last = float(steps[1]), float(steps[3])
        return np.deg2rad(first + last * np.arange(count) if steps[2] == "," else np.linspace(first, last, count))

    def gantry_sign(self, convention: str) -> float:
        """Returns the factor that turns stored angles into the gantry's: +1 for the gantry's angles, −1 for the sample's.
        convention: the format's, "gantry" or "sample"; the options' comes first."""
        return 1.0 if (self.rotates or convention) == "gantry" else -1.0

    def called(self, name: str, in_file: Mapping[str, str] | None = None) -> str:
        """Returns what messages call a field: the file's name for it (``in_file``) if the user gave no option, else the
        option that was given, such as fps for frame_time_s."""
        if in_file and name in in_file and getattr(self, name, None) is None:
            return in_file[name]
        word = _WORD_OF.get(name, name)
        return self.named(name if getattr(self, word) is None else word)

    def refuse_unused(self, form: str, used: tuple[str, ...]) -> None:
        """Raises InputError for an option that the format ``form`` does not read."""
        for name in self.given(tuple(name for name in FIELDS if name not in (*used, *_WORD_OF.values()))):
            subject, found = f"{self.called(name)} with format {form}", str(getattr(self, name))
            expected = "no such option: the files state it, or it has no meaning there"
            raise InputError(subject, found, expected, "leave the option out")


_WORD_OF = {
    "readout_axis": "first", "readout_direction": "first", "frame_time_s": "fps", "exposure_s": "exposure_ms",
    "readout_s": "readout_ms",
}  # fmt: skip
_DEFAULTS = {item.name: item.default for item in fields(ImportOptions) if item.name != "named"}
WORDS = {item.name: item.metadata["words"] for item in fields(ImportOptions) if "words" in item.metadata}
"""The words that an import option accepts, by the option's name."""
FIELDS = tuple(_DEFAULTS)
"""The names of all import options."""

# Groups of options that formats accept because their files may lack these values.
TIMING = (
    *("exposure_s", "readout_s", "frame_time_s", "angle_at", "readout_axis", "readout_direction"),
    *("first", "fps", "exposure_ms", "readout_ms"),
)
OF_BARE_FRAMES = (
    *TIMING,
    *("source_to_axis_mm", "source_to_detector_mm", "pixel_size_mm", "detector_offset_mm", "rotates"),
    *("row_0", "column_0", "quantity", "flat_value", "detector_model", "angles", "flats"),
)
OF_FOLDERS = (*OF_BARE_FRAMES, "frames")
OF_HDF5 = (*OF_BARE_FRAMES, "entry", "at", "linked_folder")


def option_name(field: str) -> str:
    """Returns the command line's option for a field of ImportOptions: --fps for "frame_time_s"."""
    return "--detector-offset" if field == "detector_offset_mm" else flag_of(_WORD_OF.get(field, field))
