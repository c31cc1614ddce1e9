"""What the user says about a foreign scan that its files do not say, or say differently."""

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
    """Options of an import; None leaves it to the file, or to the format's custom.

    Timing: ``exposure_s`` and ``readout_s`` of a frame; ``frame_time_s`` from one opening to the next: the gantry turned
    without a stop; ``angle_at``: a frame's angle is that of its first line's opening ("start") or mid-exposure. Readout
    axis and direction are those of the imported scan: row 0 the lowest, column 0 on the left, seen from the source.
    In a data sheet's words: ``first`` ("top", "bottom", "left", "right") is the line that is read first and states axis and
    direction; ``fps`` states the frame time, ``readout_ms`` the readout. Two that contradict are refused.
    Geometry: distances, pixel size and detector offset (v, u) in mm; ``unit_mm``: a scene unit where formats have none;
    ``rotates``: what the angles turn; ``row_0``, ``column_0``: where the first stored ones are, seen from the source.
    Pixels: ``quantity`` that is stored; ``flat_value``: counts without an object, where there are no flat frames.
    ``part``: which projections of a benchmark folder; ``first_view``: where this scan begins in a file of several.
    ``named``: how messages call a field; by itself as Python does.
    """

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
        for name in (*_POSITIVE, *_TIMES):
            if (value := getattr(self, name)) is not None:
                if name in _TIMES:
                    checks.at_least(self.named(name), value, 0)
                else:
                    checks.positive(self.named(name), value)
        if self.first_view is not None:
            checks.within(self.named("first_view"), self.first_view, 0, 1_000_000)
        for length in self.pixel_size_mm or ():
            checks.positive(self.named("pixel_size_mm"), length)
        for length in self.detector_offset_mm or ():
            checks.within(self.named("detector_offset_mm"), length, -1e6, 1e6)
        self._take_words()

    def _take_words(self) -> None:
        """What the words of a data sheet state, in the fields that every format reads."""
        axis, direction = readout_order(self.first, self.readout_axis, self.readout_direction, self.named)
        stated = {
            "readout_axis": axis,
            "readout_direction": direction,
            "frame_time_s": frame_time_of(self.fps, self.frame_time_s, self.named),
            "readout_s": readout_of(self.readout_ms, self.readout_s, self.named),
        }
        for name, value in stated.items():
            object.__setattr__(self, name, value)

    def given(self, among: tuple[str, ...]) -> list[str]:
        """Those fields of ``among`` that the user gave."""
        return [name for name in among if getattr(self, name) != _DEFAULTS[name]]

    def called(self, name: str) -> str:
        """How messages call a field, by the word of a data sheet where the user gave that."""
        word = _WORD_OF.get(name, name)
        return self.named(name if getattr(self, word) is None else word)

    def refuse_unused(self, form: str, used: tuple[str, ...]) -> None:
        """InputError for an option that the format ``form`` would pass over in silence."""
        for name in self.given(tuple(name for name in FIELDS if name not in (*used, *_WORD_OF.values()))):
            subject, found = f"{self.called(name)} with format {form}", str(getattr(self, name))
            expected = "none of it: the files say it, or it has no meaning there"
            raise InputError(subject, found, expected, "leave the option out")


_WORD_OF = {"readout_axis": "first", "readout_direction": "first", "frame_time_s": "fps", "readout_s": "readout_ms"}
_DEFAULTS = {item.name: item.default for item in fields(ImportOptions) if item.name != "named"}
FIELDS = tuple(_DEFAULTS)
"""The names of what a user may say; ``named`` is none of it."""

# what formats that say little take from the user
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
    """How the command line calls a field of ImportOptions."""
    return _OPTIONS.get(field, "--" + field.replace("_", "-"))


def needed(value: float | None, field: str, subject: str, named: Named) -> float:
    """A length that the file does not carry, from the options, or an InputError that asks for it."""
    if value is None:
        parallel = "; of a parallel beam a thousand panel widths, and one more to the detector"
        remedy = f"say {named(field)}{parallel if field.startswith('source_to') else ''}"
        raise InputError(subject, "nothing", "a length in mm", remedy)
    return value
