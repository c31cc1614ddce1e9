"""Options of an import: values that a foreign scan's files do not state, or that replace theirs."""

from dataclasses import dataclass, field, fields

from phyradgs_cl import checks
from phyradgs_cl.acquisition.readout import SIDES, Named, frame_time_of, readout_of, readout_order
from phyradgs_cl.acquisition.scan import DETECTOR_MODELS
from phyradgs_cl.acquisition.shutter import AXES
from phyradgs_cl.errors import InputError

WORDS: dict[str, tuple[str, ...]] = {
    "part": ("train", "test", "all"),
    "angle_at": ("start", "middle"),
    "quantity": ("attenuation", "transmission", "counts"),
    "rotates": ("gantry", "sample"),
    "row_0": ("top", "bottom"),
    "column_0": ("left", "right"),
    "readout_axis": AXES,
    "first": SIDES,
    "detector_model": DETECTOR_MODELS,
}
_POSITIVE = ("frame_time_s", "source_to_axis_mm", "source_to_detector_mm", "flat_value", "unit_mm")
_TIMES = ("exposure_s", "readout_s")


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import. None leaves a value to the file or to the format's convention.

    Timing: ``exposure_s`` and ``readout_s`` of a frame; ``frame_time_s`` from one opening to the next, of a gantry that
    turned without a stop; ``angle_at``: a frame's angle is that of its first line's opening ("start") or mid-exposure
    ("middle"). Readout axis and direction are those of the imported scan: row 0 the lowest, column 0 on the left, seen from
    the source. In a data sheet's words: ``first`` ("top", "bottom", "left", "right") is the line that is read first and
    states axis and direction; ``fps`` states the frame time, ``readout_ms`` the readout. Contradictions are refused.
    Geometry: distances, pixel size and detector offset (v, u) in mm; ``unit_mm``: length of a scene unit of formats without
    millimetres; ``rotates``: gantry or sample; ``row_0``, ``column_0``: places of the first stored ones, seen from the
    source. Pixels: the stored ``quantity``; ``flat_value``: counts without an object, where there are no flat frames.
    ``part``: the projections of a benchmark folder; ``first_view``: the first view of this scan in a file of several.
    ``named``: returns the name of a field in messages."""

    exposure_s: float | None = None
    readout_s: float | None = None
    frame_time_s: float | None = None
    angle_at: str | None = None
    readout_axis: str | None = None
    readout_direction: int | None = None
    source_to_axis_mm: float | None = None
    source_to_detector_mm: float | None = None
    pixel_size_mm: tuple[float, float] | None = None
    detector_offset_mm: tuple[float, float] | None = None
    unit_mm: float = 1.0
    rotates: str | None = None
    row_0: str | None = None
    column_0: str | None = None
    quantity: str | None = None
    flat_value: float | None = None
    detector_model: str | None = None
    part: str = "train"
    first_view: int | None = None
    first: str | None = None
    fps: float | None = None
    readout_ms: float | None = None
    named: Named = field(default=str, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name, allowed in {**WORDS, "readout_direction": (1, -1)}.items():
            if getattr(self, name) is not None:
                checks.one_of(self.named(name), getattr(self, name), allowed)
        for name in _POSITIVE:
            if getattr(self, name) is not None:
                checks.positive(self.named(name), getattr(self, name))
        for name in _TIMES:
            if getattr(self, name) is not None:
                checks.at_least(self.named(name), getattr(self, name), 0)
        if self.first_view is not None:
            checks.within(self.named("first_view"), self.first_view, 0, 1_000_000)
        for length in self.pixel_size_mm or ():
            checks.positive(self.named("pixel_size_mm"), length)
        for length in self.detector_offset_mm or ():
            checks.within(self.named("detector_offset_mm"), length, -1e6, 1e6)
        self._take_words()

    def _take_words(self) -> None:
        """Converts the words of a data sheet to the fields that every format reads."""
        axis, direction = readout_order(self.first, self.readout_axis, self.readout_direction, self.named)
        stated = {
            "readout_axis": axis, "readout_direction": direction,
            "frame_time_s": frame_time_of(self.fps, self.frame_time_s, self.named),
            "readout_s": readout_of(self.readout_ms, self.readout_s, self.named),
        }
        for name, value in stated.items():
            object.__setattr__(self, name, value)

    def given(self, among: tuple[str, ...]) -> list[str]:
        return [name for name in among if getattr(self, name) != _DEFAULTS[name]]

    def called(self, name: str) -> str:
        """Returns the name of a field in messages: the word of a data sheet where the user gave that."""
        word = _WORD_OF.get(name, name)
        return self.named(name if getattr(self, word) is None else word)

    def refuse_unused(self, form: str, used: tuple[str, ...]) -> None:
        """Raises InputError for an option that the format ``form`` does not read."""
        for name in self.given(tuple(name for name in FIELDS if name not in (*used, *_WORD_OF.values()))):
            subject, found = f"{self.called(name)} with format {form}", str(getattr(self, name))
            expected = "no such option: the files state it, or it has no meaning there"
            raise InputError(subject, found, expected, "leave the option out")


_WORD_OF = {"readout_axis": "first", "readout_direction": "first", "frame_time_s": "fps", "readout_s": "readout_ms"}
_DEFAULTS = {item.name: item.default for item in fields(ImportOptions) if item.name != "named"}
FIELDS = tuple(_DEFAULTS)
"""The names of the options, without ``named``."""

# options of formats whose files state little
TIMING = (
    *("exposure_s", "readout_s", "frame_time_s", "angle_at", "readout_axis", "readout_direction"),
    *("first", "fps", "readout_ms"),
)
OF_BARE_FRAMES = (
    *TIMING,
    *("source_to_axis_mm", "source_to_detector_mm", "pixel_size_mm", "detector_offset_mm", "rotates"),
    *("row_0", "column_0", "quantity", "flat_value", "detector_model"),
)
_OPTIONS = {"readout_axis": "--readout", "detector_offset_mm": "--detector-offset"}


def option_name(field: str) -> str:
    """Returns the option of the command line for a field of ImportOptions."""
    return _OPTIONS.get(field, "--" + field.replace("_", "-"))


def needed(value: float | None, field: str, subject: str, named: Named) -> float:
    """Returns a length that the file does not hold, from the options; InputError that asks for it where it is missing."""
    if value is None:
        raise InputError(subject, "nothing", "a length in mm", f"say {named(field)}")
    return value
